"""What a component is and what runs it: the base class that users write, its loop, and `Scope`, the blocking handle."""
