"""Components and what runs them: the base class that users write, its loop, and `Scope`, the blocking handle."""
