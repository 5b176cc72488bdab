"""A recorded run published again, which programs join as they join a running experiment (`afspm replay`)."""
