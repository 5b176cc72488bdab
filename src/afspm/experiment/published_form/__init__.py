"""Experiment files in the form of the published implementation, converted as they are read.

`files` knows the published classes with their afspm counterparts, and `short_form` writes the same experiment in
afspm's form for `afspm check --explain`. Code that imports published modules is not run: an imitation of these
modules would bring back their loops and sockets, and a guess at the effect of a function would move the tip.
"""
