"""Deterministic simulation: a whole experiment in one thread, on a fake clock, over an in-memory network.

One seed drives everything: who does what when, delays, lost connections, doubles, kills and freezes. After every step
of the scheduler the invariants are checked. A seed that fails replays exactly.
"""
