"""Commissioning of a controller: `afspm commission` guides a physicist step by step, at first with the tip withdrawn.

The steps use the scheduler and the translator of the experiment file, within its limits.
"""
