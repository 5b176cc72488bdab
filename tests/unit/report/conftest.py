"""Fixtures of a record to write into."""

from record_fixtures import night, store

__all__ = ["night", "store"]
