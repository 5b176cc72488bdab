"""Bluesky: the microscope as devices of its plans (`microscope`), and recorded runs as its documents (`documents`)."""
