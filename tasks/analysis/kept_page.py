"""A page that was written, kept with what it was made from: it is given again while that is the same."""

from __future__ import annotations

import hashlib
from contextlib import suppress
from pathlib import Path
from typing import Any, Self

from pydantic import BaseModel

from inflight.tasks.report import write_page


class KeptPage(BaseModel):
    """A page that was written, with a hash of what it was made from: given again while that is the same."""

    made_from: str
    page: Path
    page_sha256: str
    _content: bytes = b""

    @classmethod
    def of(cls, path: Path, page: str, made_from: str, **others: Any) -> Self:
        """Return what is kept of a page at a path; `others` are fields of a class of its own."""
        sha256 = hashlib.sha256(page.encode("utf-8")).hexdigest()
        return cls(made_from=made_from, page=path.resolve(), page_sha256=sha256, **others)

    @classmethod
    def read(cls, path: Path) -> Self | None:
        """Return what `save` wrote; None without any, and where the page has gone or was changed by hand."""
        try:
            kept = cls.model_validate_json(path.read_bytes())
            kept._content = kept.page.read_bytes()
        except (OSError, ValueError):
            return None
        return kept if hashlib.sha256(kept._content).hexdigest() == kept.page_sha256 else None

    def save(self, path: Path) -> None:
        """Write it; a workspace that can only be read keeps nothing, nor is a path kept that is no UTF-8."""
        with suppress(OSError, ValueError):
            write_page(path, self.model_dump_json())

    def copy_to(self, output: Path) -> None:
        """Write the page that was read where it is asked for, unless it is there already."""
        there = None
        with suppress(OSError):
            there = output.read_bytes()
        if there != self._content:
            write_page(output, self._content.decode("utf-8"))
