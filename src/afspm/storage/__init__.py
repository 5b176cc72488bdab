"""What is kept on disk: files replaced atomically, saved state, and the threads that write and sync."""
