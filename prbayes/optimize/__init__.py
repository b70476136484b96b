"""The deterministic optimiser."""
