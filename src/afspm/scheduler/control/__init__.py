"""Decisions about control: the arbitration table, leases and grace periods, problems, begin and end of an experiment."""
