"""A user's own effects: Python files that the mission YAML names under ``effects:``.

The core opens no file: the caller makes an `EffectSource` of path and text. Its classes are made once a
process for each text, so that two workspaces never share a class unnoticed and a changed file means a new
one. Workers make them from the text that travels with the pickled effects.
"""

from __future__ import annotations

import hashlib
import linecache
import sys
import traceback
from collections.abc import Iterable
from dataclasses import dataclass
from types import ModuleType

from inflight.effects.base import Effect
from inflight.errors import ModelError

_made: dict[tuple[str, str], dict[str, type[Effect]]] = {}

#: Keys of a model's entry that no parameter may be called.
_RESERVED = {"effect", "name", "sensor", "source"}


@dataclass(frozen=True)
class EffectSource:
    """One file with effects.

    Attributes
    ----------
    path : str
        As the mission YAML names it; used in errors and tracebacks.
    text : str
        Python.
    """

    path: str
    text: str

    @property
    def sha(self) -> str:
        """First 16 hexadecimal digits of the text's sha256: what a model pins."""
        return hashlib.sha256(self.text.encode()).hexdigest()[:16]

    def classes(self) -> dict[str, type[Effect]]:
        """Return the effects the file defines, by their registered names; the file runs once a process.

        Raises
        ------
        ModelError
            Naming file and line of a syntax error or of what fails when it is imported, or when it
            defines no effect, or one that does nothing.
        """
        key = (self.path, self.sha)
        if key not in _made:
            _made[key] = self._make()
        return _made[key]

    def _make(self) -> dict[str, type[Effect]]:
        """Run the file, and check the classes of effects it defines."""
        module = self._run()
        own = [kind for kind in vars(module).values() if isinstance(kind, type) and issubclass(kind, Effect)]
        kinds = [
            kind for kind in own if kind.__module__ == module.__name__ and not kind.__name__.startswith("_")
        ]
        if not kinds:
            raise ModelError(
                "the file defines no effect",
                file=self.path,
                remedy="write a class that inherits inflight.Effect; its name is the effect's",
            )
        for kind in kinds:
            require_sound_class(kind, self.path)
            kind.source = self
        return {kind.label(): kind for kind in kinds}

    def _run(self) -> ModuleType:
        """Run the file as a module of its own; an error names the line of the file it came through."""
        name = f"inflight_effects_{hashlib.sha256(self.path.encode()).hexdigest()[:8]}_{self.sha}"
        module = ModuleType(name)
        module.__file__ = self.path
        # Tracebacks and dataclasses look here for the text and the module.
        linecache.cache[self.path] = (len(self.text), None, self.text.splitlines(keepends=True), self.path)
        sys.modules[name] = module
        try:
            exec(compile(self.text, self.path, "exec"), module.__dict__)
        except SyntaxError as error:
            sys.modules.pop(name)
            raise ModelError(
                f"line {error.lineno}: not Python: {error.msg}", file=self.path, remedy="correct the line"
            ) from None
        except Exception as error:
            sys.modules.pop(name)
            frames = traceback.extract_tb(error.__traceback__)
            lines = [frame.lineno for frame in frames if frame.filename == self.path and frame.lineno]
            raise ModelError(
                f"line {lines[-1] if lines else '?'}: {type(error).__name__}: {error}",
                file=self.path,
                remedy="the file must run without an error when it is imported",
            ) from error
        return module


def require_sound_class(kind: type[Effect], file: str) -> None:
    """Refuse a class that cannot be an effect.

    Raises
    ------
    ModelError
        Naming `file`, when it neither adds a field nor corrects, has only one of two inverses, or calls a
        parameter as every effect calls something else.
    """
    if kind.field is Effect.field and kind.is_plain_field():
        raise ModelError(
            f"class {kind.__name__} says nothing of what it does",
            file=file,
            remedy="give it a method field(self, samples, values, sensor), or 'correct' and 'disturb'",
        )
    if (kind.correct is Effect.correct) != (kind.disturb is Effect.disturb):
        raise ModelError(
            f"class {kind.__name__} has only one of 'correct' and 'disturb'",
            file=file,
            remedy="write both: each must undo the other exactly",
        )
    if taken := (_RESERVED | set(dir(Effect))) & set(kind.parameters()):
        raise ModelError(
            f"class {kind.__name__} calls a parameter {', '.join(sorted(taken))}",
            file=file,
            remedy="choose another name: every effect has that one already",
        )


def own_effects(sources: Iterable[EffectSource]) -> dict[str, type[Effect]]:
    """Return the effects of some files by name.

    Raises
    ------
    ModelError
        When a file is wrong, or two of them define one name.
    """
    found: dict[str, type[Effect]] = {}
    for source in sources:
        for label, kind in source.classes().items():
            if label in found:
                other = found[label].source
                raise ModelError(
                    f"effect '{label}' is defined in {other.path if other else '?'} too",
                    file=source.path,
                    remedy="rename one of the classes",
                )
            found[label] = kind
    return found
