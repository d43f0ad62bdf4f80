"""The tables of the catalog's database. A change here needs a migration in ``migrations/versions``."""

from __future__ import annotations

import datetime as dt
import json
from dataclasses import fields
from typing import TYPE_CHECKING, Any, ClassVar, TypeVar

from sqlalchemy import (
    JSON,
    BigInteger,
    Date,
    Float,
    ForeignKey,
    Index,
    Integer,
    String,
    Text,
    TypeDecorator,
    UniqueConstraint,
)
from sqlalchemy.orm import DeclarativeBase, Mapped, mapped_column

if TYPE_CHECKING:
    from _typeshed import DataclassInstance

Record = TypeVar("Record", bound="DataclassInstance")
#: SQLite numbers rows by itself only in columns declared INTEGER.
_Id = BigInteger().with_variant(Integer, "sqlite")
#: Names sort the same on both databases.
_Name = String().with_variant(String(collation="C"), "postgresql")


class _PlainText(TypeDecorator[str]):
    """Text without NUL, which PostgreSQL refuses: messages may quote what stood in a broken file."""

    impl = Text
    cache_ok = True

    def process_bind_param(self, value: str | None, dialect: Any) -> str | None:
        return None if value is None else value.replace("\0", "\N{REPLACEMENT CHARACTER}")


_Message = Text().with_variant(_PlainText(), "postgresql")


class _JsonText(TypeDecorator[Any]):
    """JSON as text: PostgreSQL's own JSON refuses the NaN that reports may hold."""

    impl = Text
    cache_ok = True

    def process_bind_param(self, value: Any, dialect: Any) -> str | None:
        return None if value is None else json.dumps(value)

    def process_result_value(self, value: str | None, dialect: Any) -> Any:
        return None if value is None else json.loads(value)


_Json = JSON().with_variant(_JsonText(), "postgresql")


class Base(DeclarativeBase):
    """Base of all tables."""

    type_annotation_map: ClassVar[dict[Any, Any]] = {
        dict[str, Any]: _Json,
        list[Any]: _Json,
        str: _Name,
        int: BigInteger,
        dt.date: Date,
        float: Float,
    }

    def as_record(self, record: type[Record], **others: Any) -> Record:
        """Return this row as a frozen record of `inflight.catalog.records`.

        Parameters
        ----------
        record : type
            Its fields take the columns of the same names.
        **others
            Fields that are no column, or differ from it.
        """
        names = {item.name for item in fields(record)} & set(self.__table__.columns.keys()) - set(others)
        return record(**{name: getattr(self, name) for name in names}, **others)


class RunRow(Base):
    """One run; host, pid and `process` (start of the process) identify its process.

    `lease` is until when it is taken for alive, s since 1970 on the database's clock; None where its process
    is looked at.
    """

    __tablename__ = "run"
    id: Mapped[str] = mapped_column(primary_key=True)
    kind: Mapped[str]
    settings: Mapped[dict[str, Any]]
    context: Mapped[str | None]
    state: Mapped[str] = mapped_column(index=True)
    cause: Mapped[str] = mapped_column(default="")
    message: Mapped[str] = mapped_column(_Message, default="")
    host: Mapped[str]
    pid: Mapped[int]
    process: Mapped[str]
    started: Mapped[str]
    ended: Mapped[str | None]
    lease: Mapped[float | None]
    #: What a run that was done says of itself; None of those that said nothing. Read when it is asked for.
    report: Mapped[dict[str, Any] | None] = mapped_column(_Json, default=None, deferred=True)


class DatasetRow(Base):
    """A named dataset, such as ``l1/fgm``."""

    __tablename__ = "dataset"
    id: Mapped[int] = mapped_column(_Id, primary_key=True)
    name: Mapped[str] = mapped_column(unique=True)


class StoreRow(Base):
    """One immutable store; `path` is relative to the workspace, `sha256` that of its manifest."""

    __tablename__ = "store"
    id: Mapped[int] = mapped_column(_Id, primary_key=True)
    path: Mapped[str] = mapped_column(unique=True)
    sha256: Mapped[str]
    bytes: Mapped[int]
    notes: Mapped[list[Any]]
    run_id: Mapped[str] = mapped_column(ForeignKey("run.id"))


class DayRow(Base):
    """One day of one dataset as one run left it; version and revision come with publication."""

    __tablename__ = "day"
    __table_args__ = (
        UniqueConstraint("run_id", "dataset_id", "day", name="one_day_per_run"),
        UniqueConstraint("dataset_id", "day", "baseline", "revision", name="version_never_reused"),
        Index("day_by_dataset", "dataset_id", "day"),
        Index("day_by_key", "key"),
    )
    id: Mapped[int] = mapped_column(_Id, primary_key=True)
    dataset_id: Mapped[int] = mapped_column(ForeignKey("dataset.id"))
    day: Mapped[dt.date]
    run_id: Mapped[str] = mapped_column(ForeignKey("run.id"))
    context: Mapped[str | None]
    state: Mapped[str]
    cause: Mapped[str] = mapped_column(default="")
    message: Mapped[str] = mapped_column(_Message, default="")
    key: Mapped[str] = mapped_column(default="")
    report: Mapped[dict[str, Any]] = mapped_column(default=dict)
    coverage: Mapped[float | None]
    baseline: Mapped[int | None]
    revision: Mapped[int | None]
    store_id: Mapped[int | None] = mapped_column(ForeignKey("store.id"), index=True)
    start: Mapped[int] = mapped_column(default=0)
    stop: Mapped[int] = mapped_column(default=0)
    first_tt2000: Mapped[int] = mapped_column(default=0)
    last_tt2000: Mapped[int] = mapped_column(default=0)
    count: Mapped[int] = mapped_column(default=0)
    step_ns: Mapped[int] = mapped_column(default=0)


class CurrentRow(Base):
    """The pointer that publication moves: which revision of a day is the present one."""

    __tablename__ = "current"
    dataset_id: Mapped[int] = mapped_column(ForeignKey("dataset.id"), primary_key=True)
    day: Mapped[dt.date] = mapped_column(primary_key=True)
    day_id: Mapped[int] = mapped_column(ForeignKey("day.id"))


class TableRow(Base):
    """A calibration table: a store and the half-open TT2000 span it was made for."""

    __tablename__ = "calibration_table"
    id: Mapped[int] = mapped_column(_Id, primary_key=True)
    name: Mapped[str] = mapped_column(index=True)
    run_id: Mapped[str] = mapped_column(ForeignKey("run.id"))
    store_id: Mapped[int] = mapped_column(ForeignKey("store.id"))
    start: Mapped[int]
    end: Mapped[int]
    key: Mapped[str] = mapped_column(default="")
    context: Mapped[str | None]


class CertificationRow(Base):
    """A table is valid in ``[start, end)``; validities of one name and context never overlap."""

    __tablename__ = "certification"
    __table_args__ = (Index("certification_by_name", "name", "context", "start"),)
    id: Mapped[int] = mapped_column(_Id, primary_key=True)
    table_id: Mapped[int] = mapped_column(ForeignKey("calibration_table.id"))
    name: Mapped[str]
    #: Empty for tables that hold in any context: NULLs would not compare equal.
    context: Mapped[str]
    start: Mapped[int]
    end: Mapped[int]


class CertificationActRow(Base):
    """What was done to validities, in order: replayed up to a time, it tells what was valid by then."""

    __tablename__ = "certification_act"
    __table_args__ = (Index("certification_act_by_name", "name", "context"),)
    id: Mapped[int] = mapped_column(_Id, primary_key=True)
    table_id: Mapped[int] = mapped_column(ForeignKey("calibration_table.id"))
    name: Mapped[str]
    context: Mapped[str]
    act: Mapped[str]
    start: Mapped[int]
    end: Mapped[int]
    author: Mapped[str]
    reason: Mapped[str] = mapped_column(_Message)
    created: Mapped[str]
    run_id: Mapped[str | None] = mapped_column(ForeignKey("run.id"))


class ApprovalRow(Base):
    """A person answers for a table: definitive releases need one of each table that products took."""

    __tablename__ = "approval"
    __table_args__ = (Index("approval_by_table", "table_id"),)
    id: Mapped[int] = mapped_column(_Id, primary_key=True)
    table_id: Mapped[int] = mapped_column(ForeignKey("calibration_table.id"))
    person: Mapped[str]
    note: Mapped[str] = mapped_column(Text, default="")
    created: Mapped[str]


class ModelRow(Base):
    """One version of a model file."""

    __tablename__ = "model"
    __table_args__ = (UniqueConstraint("name", "version", name="model_version_never_reused"),)
    id: Mapped[int] = mapped_column(_Id, primary_key=True)
    name: Mapped[str]
    version: Mapped[int]
    parent: Mapped[int | None]
    text: Mapped[str] = mapped_column(Text)
    sha256: Mapped[str]
    message: Mapped[str] = mapped_column(_Message, default="")
    created: Mapped[str]
    change: Mapped[dict[str, Any] | None]


class ContextRow(Base):
    """What a context pins; its id is the hash of the rest. `tables`: name -> list of [table, start, end]."""

    __tablename__ = "context"
    id: Mapped[str] = mapped_column(primary_key=True)
    mission_text: Mapped[str] = mapped_column(Text)
    model_name: Mapped[str]
    model_version: Mapped[int]
    tables: Mapped[dict[str, Any]]


class NamedContextRow(Base):
    """The context of each comparison that a name stands for, and the run whose choices go with it."""

    __tablename__ = "named_context"
    name: Mapped[str] = mapped_column(primary_key=True)
    comparison: Mapped[str] = mapped_column(primary_key=True)
    context_id: Mapped[str] = mapped_column(ForeignKey("context.id"))
    run_id: Mapped[str] = mapped_column(ForeignKey("run.id"))
    author: Mapped[str]
    reason: Mapped[str] = mapped_column(_Message)
    #: Up to when it knows what was done, ISO 8601.
    as_of: Mapped[str]
    created: Mapped[str]


class FileRow(Base):
    """A delivered file; `taken` once the days made from it are published."""

    __tablename__ = "file"
    __table_args__ = (
        UniqueConstraint("run_id", "instrument", "path", name="one_file_per_run"),
        Index("file_by_instrument", "instrument", "path"),
        Index("file_by_sha256", "sha256"),
    )
    id: Mapped[int] = mapped_column(_Id, primary_key=True)
    run_id: Mapped[str] = mapped_column(ForeignKey("run.id"))
    instrument: Mapped[str]
    path: Mapped[str] = mapped_column(Text)
    sha256: Mapped[str]
    size: Mapped[int]
    mtime_ns: Mapped[int]
    days: Mapped[list[Any]]
    report: Mapped[dict[str, Any]]
    taken: Mapped[bool] = mapped_column(default=False)


class EdgeRow(Base):
    """Lineage: `child` was made from `parent`; both are lineage ids such as ``day:12``."""

    __tablename__ = "lineage"
    parent: Mapped[str] = mapped_column(primary_key=True)
    child: Mapped[str] = mapped_column(primary_key=True, index=True)


class ReleaseRow(Base):
    """A frozen collection."""

    __tablename__ = "release"
    id: Mapped[int] = mapped_column(_Id, primary_key=True)
    version: Mapped[str] = mapped_column(unique=True)
    context: Mapped[str | None]
    notes: Mapped[str] = mapped_column(Text, default="")
    path: Mapped[str] = mapped_column(Text)
    created: Mapped[str]
    maturity: Mapped[str] = mapped_column(default="preliminary", server_default="preliminary")


class ReleaseDayRow(Base):
    """A day of a frozen collection."""

    __tablename__ = "release_day"
    release_id: Mapped[int] = mapped_column(ForeignKey("release.id"), primary_key=True)
    day_id: Mapped[int] = mapped_column(ForeignKey("day.id"), primary_key=True)


class SettingRow(Base):
    """A setting of the workspace."""

    __tablename__ = "setting"
    name: Mapped[str] = mapped_column(primary_key=True)
    value: Mapped[str]
