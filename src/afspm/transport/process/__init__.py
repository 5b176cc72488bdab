"""Shared by all processes of an experiment: host, bond to the parent, loading of classes, failures, log, memory."""
