"""Base of all other rooms: errors, units, clock, formatting, addresses, file locks, launch lines, entry points.

Nothing here knows a microscope, a message or a socket. A module belongs here if at least two rooms need it and it
imports nothing of afspm but its neighbours.
"""
