"""`afspm replay`: publication of a recorded run, which programs can join like a running experiment."""
