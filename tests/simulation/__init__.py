"""Deterministic simulation: a whole experiment in one thread, on a fake clock, over an in-memory network.

One seed determines everything: actions and their times, delays, lost connections, duplicates, kills and freezes. After
every step of the scheduler the invariants are checked. A failing seed replays exactly.
"""
