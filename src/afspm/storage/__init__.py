"""Files that are replaced atomically, saved state, the packet log, and the threads that write and sync."""
