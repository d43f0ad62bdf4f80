"""What a workspace's stores look like from outside."""

from pathlib import Path


def unfinished_stores(workspace: Path) -> list[Path]:
    """Return the stores without a manifest, and the folders of runs without a store."""
    stores = list((workspace / "stores").glob("*/*"))
    empty = [one for one in (workspace / "stores").glob("*") if not any(one.iterdir())]
    return [*(one for one in stores if not (one / "MANIFEST.sha256").exists()), *empty]
