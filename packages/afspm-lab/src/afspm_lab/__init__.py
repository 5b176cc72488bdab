"""The laboratory beside afspm: replays of nights with a change, and studies of settings in simulated nights."""
