"""For those who write drivers, components and clients: conformance suites, commissioning, skeletons.

No process of a run imports this room.
"""
