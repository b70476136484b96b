"""Emulators: what a response is about between its runs, and by how much that is wrong."""
