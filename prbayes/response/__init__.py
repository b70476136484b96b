"""The user's response: its inputs, how it is called, when it fails, where it is kept."""
