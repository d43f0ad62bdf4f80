"""A workspace: the one folder that holds a mission's YAML, models, deliveries and catalog.

```
mission.yaml     the mission; written by hand or copied by `inflight new`
models/          model files, the pre-flight calibration among them
data/            delivered files, laid out as the mission's file patterns say
catalog.db       the catalog, or catalog.yaml with its address; staging/, stores/ and releases/ are its own
reports/         pages written by `inflight compare`
.prefect/        private home of the embedded Prefect server
```
"""

from __future__ import annotations

import shutil
from dataclasses import dataclass
from importlib.resources import files
from pathlib import Path

from inflight.errors import WorkspaceError
from inflight.mission import Mission

MISSION_FILE = "mission.yaml"
#: Deliveries are looked for here unless a command names another folder.
DATA_FOLDER = "data"


@dataclass(frozen=True)
class Workspace:
    """Paths of one workspace; `open` and `create` make sure that it is one.

    Parameters
    ----------
    root : Path
        The folder.
    """

    root: Path

    @classmethod
    def open(cls, root: Path | str) -> Workspace:
        """Return the workspace in a folder.

        Raises
        ------
        WorkspaceError
            When the folder holds no ``mission.yaml``.
        """
        workspace = cls(Path(root))
        if not workspace.mission_file.is_file():
            found = "exists but holds no mission.yaml" if workspace.root.is_dir() else "does not exist"
            raise WorkspaceError(
                f"{workspace.root} is no workspace: it {found}",
                remedy="make one with 'inflight new MISSION DIR', or name another with --workspace",
                file=str(workspace.mission_file),
            )
        return workspace

    @classmethod
    def create(cls, root: Path | str, mission: str | Path) -> Workspace:
        """Make a workspace from a shipped mission or a YAML file.

        The mission, its pre-flight model and its effect files are copied, so that the workspace
        stays as it is when the originals change.

        Parameters
        ----------
        root : Path or str
            Folder to make; it may exist.
        mission : str or Path
            Name of a shipped mission (see `shipped_missions`), or path of a YAML.

        Raises
        ------
        WorkspaceError
            When the folder is a workspace already, or there is no such mission or no file it names.
        MissionError
            When the YAML is wrong.
        """
        workspace, source = cls(Path(root)), find_mission(mission)
        if workspace.mission_file.exists():
            raise WorkspaceError(
                f"{workspace.root} is a workspace already; nothing was changed",
                remedy="choose another folder, or edit its mission.yaml",
                file=str(workspace.mission_file),
            )
        parsed = _parse(source)
        companions = {
            name: source.parent / name for name in parsed.companions if not Path(name).is_absolute()
        }
        for name, path in companions.items():
            if ".." in Path(name).parts or not path.is_file():
                raise WorkspaceError(
                    f"the mission names {name!r}, and there is no such file beside or below it",
                    remedy="put the file there or take the name out of the YAML",
                    file=str(source),
                )
        for folder in (workspace.models, workspace.data, workspace.reports):
            folder.mkdir(parents=True, exist_ok=True)
        for name, path in companions.items():
            target = workspace.root / name
            target.parent.mkdir(parents=True, exist_ok=True)
            shutil.copyfile(path, target)
        # Last, because this file is what makes the folder a workspace.
        workspace.mission_file.write_text(parsed.text, encoding="utf-8")
        return workspace

    @property
    def mission_file(self) -> Path:
        """The mission YAML."""
        return self.root / MISSION_FILE

    @property
    def models(self) -> Path:
        """Folder of model files."""
        return self.root / "models"

    @property
    def data(self) -> Path:
        """Folder of deliveries."""
        return self.root / DATA_FOLDER

    @property
    def reports(self) -> Path:
        """Folder of written pages."""
        return self.root / "reports"

    @property
    def prefect_home(self) -> Path:
        """Private home of the embedded Prefect server."""
        return self.root / ".prefect"

    def mission(self) -> Mission:
        """Read the mission.

        Raises
        ------
        WorkspaceError
            When there is no mission YAML any more.
        MissionError
            Naming file, line and key of everything that is wrong.
        """
        return _parse(Workspace.open(self.root).mission_file)

    def relative(self, path: Path | str) -> str:
        """Return a path relative to the workspace when it lies in it, else as it is."""
        try:
            return str(Path(path).resolve().relative_to(self.root.resolve()))
        except ValueError:
            return str(path)


def shipped_missions() -> dict[str, Path]:
    """Return the missions that come with the software, by name; the template is one of them."""
    folder = Path(str(files("inflight"))) / "missions"
    return {path.stem: path for path in sorted(folder.glob("*.yaml"))}


def find_mission(mission: str | Path) -> Path:
    """Return the YAML of a shipped mission's name or of a path.

    Raises
    ------
    WorkspaceError
        When there is neither.
    """
    shipped = shipped_missions()
    if str(mission) in shipped:
        return shipped[str(mission)]
    path = Path(mission)
    if path.is_file():
        return path
    raise WorkspaceError(
        f"there is no shipped mission and no file {str(mission)!r}",
        remedy=f"name a YAML file or one of: {', '.join(shipped)}",
        file=str(mission),
    )


def _parse(path: Path) -> Mission:
    return Mission.parse(path.read_text(encoding="utf-8"), source=str(path))
