"""Conformance suites, commissioning and skeletons, for authors of drivers, components and clients.

No process of a run imports this room.
"""
