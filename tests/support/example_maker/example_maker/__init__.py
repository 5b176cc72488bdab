"""A maker in a package of its own: driver, emulator, files, parameters, an exporter and a command."""
