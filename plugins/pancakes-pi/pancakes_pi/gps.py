"""A pose by satellite, as gpsd tells it (`pi.gps`)."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from typing import Annotated, Any

from msgspec import Meta

from pancakes.devices.driver import Sensor
from pancakes_pi.gps_feed import GpsFeed
from pancakes_pi.gps_reports import Origin, pose_at, position_in
from pancakes_pi.real_hardware import refuse_virtual_time


class GpsPose(Sensor):
    """Where a receiver is: x metres east and y metres north of an origin, heading where it moves to (`pi.gps`)."""

    type = "pose"
    rate = "none"
    silent_s = 10.0

    @dataclass
    class Settings:
        """Which gpsd, and where x and y are 0.

        Attributes:
            lat_deg: latitude of the origin.
            lon_deg: longitude of the origin.
            host: where gpsd listens.
            port: its port.
            device: the receiver, such as `/dev/ttyUSB0`, where gpsd has several; empty: all.
            least_mps: where it moves slower, in m/s, the heading stays as it was.
        """

        lat_deg: Annotated[float, Meta(ge=-90, le=90)]
        lon_deg: Annotated[float, Meta(ge=-180, le=180)]
        host: str = "127.0.0.1"
        port: Annotated[int, Meta(ge=1, le=65535)] = 2947
        device: str = ""
        least_mps: Annotated[float, Meta(ge=0)] = 0.3

    settings: Settings
    _feed: GpsFeed | None = None

    def open(self) -> None:
        refuse_virtual_time(self.context)
        settings = self.settings
        self._origin = Origin(settings.lat_deg, settings.lon_deg)
        self._theta_rad = 0.0
        self._blind = False
        self._feed = GpsFeed(settings.host, settings.port, self, self.context.log)

    def close(self) -> None:
        if self._feed is not None:
            self._feed.close()

    def read(self) -> None:
        """Readings come by themselves."""

    def silent(self) -> None:
        """The receiver was pulled out, or the connection is dead: a new one shows which."""
        if self._feed is not None:
            self._feed.redial()

    def reported(self, report: Mapping[str, Any]) -> None:
        """A report of gpsd has come; in the feed's thread."""
        settings = self.settings
        if report.get("class") != "TPV" or (settings.device and report.get("device") != settings.device):
            return
        position = position_in(report)
        if position is None:
            self.context.alive()
            if not self._blind:
                self._blind = True
                self.context.log("warning", "the receiver does not know where it is")
            return
        if self._blind:
            self._blind = False
            self.context.log("info", "the receiver knows where it is")
        pose = pose_at(position, self._origin, settings.least_mps, self._theta_rad)
        self._theta_rad = pose.theta_rad
        self.context.deliver(pose)
