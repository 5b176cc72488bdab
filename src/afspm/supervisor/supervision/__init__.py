"""Decisions of the supervisor: liveness, restarts, and the end of a run. Pure.

The shell carries out an effect at once, and reports the start of a process or its failure as an event, so the state
never contains a process that does not exist. psutil only samples silent processes: process groups and job objects kill
them, since these also reach grandchildren whose parent has ended.
"""
