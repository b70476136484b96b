"""Pictures of results, alike on every backend of ArviZ."""
