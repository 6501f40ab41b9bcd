"""Context management for objects with a `close` method."""

from __future__ import annotations

from typing import Self


class Closing:
    """Mixin for objects with `close`, which a `with` block calls at its end."""

    def __enter__(self) -> Self:
        return self

    def __exit__(self, *_: object) -> None:
        self.close()

    def close(self) -> None:
        """Release all resources of the object."""
        raise NotImplementedError
