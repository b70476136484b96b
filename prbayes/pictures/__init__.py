"""Pictures of results: numbers first, then panels that are drawn alike on every backend."""
