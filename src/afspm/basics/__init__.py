"""Base of all other packages: errors, units, clock, formatting, addresses, file locks, launch lines, entry points.

Nothing here depends on microscopes, messages or sockets. A module belongs here if at least two packages need it, and
if it imports no other package of afspm.
"""
