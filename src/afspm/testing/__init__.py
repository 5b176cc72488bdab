"""For those who write translators and components: conformance tests, a fake clock, an in-memory network, faults."""
