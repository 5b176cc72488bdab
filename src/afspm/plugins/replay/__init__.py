"""`afspm replay`: publishes a recorded run again, so that programs can join it like a running experiment."""
