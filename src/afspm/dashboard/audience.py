"""Who is looking, so that all can be told of the end before the page goes."""

from __future__ import annotations

import threading


class Audience:
    """The pages that are open. From any thread."""

    def __init__(self) -> None:
        self._pages: set[int] = set()
        self._changed = threading.Condition()

    def __len__(self) -> int:
        return len(self._pages)

    def join(self, page: object) -> None:
        """A page was opened."""
        with self._changed:
            self._pages.add(id(page))

    def leave(self, page: object) -> None:
        """A page was closed, or has been told of the end."""
        with self._changed:
            self._pages.discard(id(page))
            self._changed.notify_all()

    def wait_told(self, within_s: float) -> bool:
        """Wait until no page is left that has not been told; False when the time is up."""
        with self._changed:
            return self._changed.wait_for(lambda: not self._pages, within_s)
