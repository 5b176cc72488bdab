"""Decisions about packets: envelopes, times, the cache for late joiners, the event log."""
