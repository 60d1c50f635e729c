"""The settings of a recording, in `[record]` and when one is started."""

from __future__ import annotations

from typing import Annotated, Literal

from msgspec import Meta, Struct

from pancakes.durable.record import TaskId
from pancakes.errors import MigrationError
from pancakes.settings import FilePath

Size = Annotated[float, Meta(ge=0, le=1e9)]


class RecordingSettings(Struct):
    """What is recorded, and where to.

    Attributes:
        path: the file; one that is there already is left alone, and a number added to the name. `{agent}` stands
            for the agent's name.
        channels: the channels to record; empty: all, including those that are added later.
        types: the packet types to record; empty: all.
        task: record only what this task (`birthplace/name`) reads and publishes, on whatever agent it is; empty:
            everything.
        split_mib: a new file begins if one has grown this large.
        limit_mib: how large the recording may become; 0 for no limit.
        at_limit: what happens then: it ends (`stop`), or its oldest file is removed (`drop_oldest`).
        free_mib: the recording ends before less than this is free on the disk, and does not begin where less is.
        viewer: whether poses are written in the schemas of Foxglove as well.
    """

    path: FilePath = "recordings/{agent}.mcap"
    channels: tuple[str, ...] = ()
    types: tuple[str, ...] = ()
    task: str = ""
    split_mib: Annotated[float, Meta(gt=0, le=1e6)] = 256.0
    limit_mib: Size = 0.0
    at_limit: Literal["stop", "drop_oldest"] = "stop"
    free_mib: Size = 64.0
    viewer: bool = True

    def __post_init__(self) -> None:
        try:
            if self.task:  # a bare name fits no task, and the recording would stay empty
                TaskId.parse(self.task)
        except MigrationError as error:
            raise ValueError(f"task: {error}") from None
