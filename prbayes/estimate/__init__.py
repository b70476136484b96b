"""The deterministic optimiser, and what is known of its answer."""
