"""Decisions of the supervisor: liveness, restarts, and the end of a run. Pure."""
