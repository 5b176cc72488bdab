"""Decisions of the supervisor: whether a process lives, when it is started again, how a run ends. Pure."""
