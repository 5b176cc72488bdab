"""Decisions about control: the arbitration table, leases and grace periods, begin and end of an experiment."""
