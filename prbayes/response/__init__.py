"""The user's response: its inputs, how it is called, what happens when it fails, where it is kept."""
