"""Pages that say more than a message can."""

from __future__ import annotations

# In the repository, and in the source distribution: the pages have no address of their own yet.
_FOLDER = "docs"


def more_in(page: str) -> str:
    """Return the end of a sentence that names a page, with the heading to look under.

    ``page`` is a constant, such as ``"choose.md#the-metric"``: tests look them all up.
    """
    return f"; see {_FOLDER}/{page}"
