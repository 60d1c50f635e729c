"""A round body of the simulated world: where it is, how it moves, how it is asked to move."""

from __future__ import annotations

import math


class Disc:
    """A round body.

    One that moves is told its velocity; it takes it up in the next step, and what it then touches takes from it what
    would bring it into something solid.

    Args:
        name: what it is called.
        radius_m: its size.
        x_m: where its centre is.
        y_m: where its centre is.
        angle_rad: its heading.
        mass_kg: its mass; infinity: it never moves.

    Attributes:
        angle_rad: its heading as its turns add up.
        vx_mps: its true velocity along the arena's x axis.
        vy_mps: the same along y.
        turning_radps: how fast it truly turns.
        top_mps: the fastest that it moves, while nothing else is asked of it.
    """

    def __init__(self, name: str, radius_m: float, x_m: float, y_m: float, angle_rad: float, mass_kg: float) -> None:
        self.name = name
        self.radius_m = radius_m
        self.mass_kg = mass_kg
        self.x_m = x_m
        self.y_m = y_m
        self.angle_rad = angle_rad
        self.vx_mps = self.vy_mps = self.turning_radps = self.top_mps = 0.0
        self._forward_mps = self._omega_radps = 0.0
        self._walk: tuple[float, float] | None = None
        self._looks_rad = angle_rad

    def roll(self, v_mps: float, omega_radps: float) -> None:
        """Moves along its heading from now on, turning at `omega_radps`."""
        self._forward_mps, self._omega_radps, self._walk = v_mps, omega_radps, None
        self.top_mps = max(self.top_mps, abs(v_mps))

    def walk(self, vx_mps: float, vy_mps: float) -> None:
        """Moves with a velocity along the arena's axes from now on, and looks where it goes."""
        self._walk = (vx_mps, vy_mps)
        self.top_mps = max(self.top_mps, math.hypot(vx_mps, vy_mps))
        if vx_mps or vy_mps:
            self._looks_rad = math.atan2(vy_mps, vx_mps)

    @property
    def position(self) -> tuple[float, float]:
        return self.x_m, self.y_m

    @property
    def velocity(self) -> tuple[float, float]:
        """Its true velocity along the arena's axes, in m/s."""
        return self.vx_mps, self.vy_mps

    @property
    def theta_rad(self) -> float:
        """Its heading, in (-pi, pi]."""
        theta_rad = self._looks_rad if self._walk is not None else self.angle_rad
        return math.pi - (math.pi - theta_rad) % math.tau

    def course(self) -> tuple[float, float, float]:
        """Returns its heading, its true speed along that, and its true turning rate: all of them for one call."""
        theta_rad = self.theta_rad
        v_mps = self.vx_mps * math.cos(theta_rad) + self.vy_mps * math.sin(theta_rad)
        return theta_rad, v_mps, 0.0 if self._walk is not None else self.turning_radps

    def asked_for(self) -> tuple[float, float, float, float]:
        """Returns its forward speed, its turning rate, and its velocity along the axes, as asked for."""
        if self._walk is not None:
            return 0.0, 0.0, *self._walk
        return self._forward_mps, self._omega_radps, 0.0, 0.0

    def moved(
        self, x_m: float, y_m: float, angle_rad: float, vx_mps: float, vy_mps: float, turning_radps: float
    ) -> None:
        """Takes over what became of it in a step."""
        self.x_m, self.y_m, self.angle_rad = x_m, y_m, angle_rad
        self.vx_mps, self.vy_mps, self.turning_radps = vx_mps, vy_mps, turning_radps
        asked_mps = math.hypot(*self._walk) if self._walk is not None else abs(self._forward_mps)
        true_mps = math.hypot(vx_mps, vy_mps)
        self.top_mps = asked_mps if asked_mps > true_mps else true_mps

    def coast(self, steps: int, dt_s: float) -> None:
        """Moves by so many steps of `dt_s`, where it meets nothing."""
        vx_mps, vy_mps, turning_radps = self.vx_mps, self.vy_mps, self.turning_radps
        x_m, y_m, angle_rad = self.x_m, self.y_m, self.angle_rad
        if self._walk is not None:
            for _ in range(steps):
                x_m += vx_mps * dt_s
                y_m += vy_mps * dt_s
                angle_rad += turning_radps * dt_s
                (vx_mps, vy_mps), turning_radps = self._walk, 0.0
        else:
            forward_mps, omega_radps = self._forward_mps, self._omega_radps
            if not (forward_mps or omega_radps or self.top_mps or turning_radps):
                return
            # The chord of the arc that the next step makes points along the heading in the middle of that step.
            half_rad = 0.5 * omega_radps * dt_s
            cos, sin = math.cos, math.sin
            for _ in range(steps):
                x_m += vx_mps * dt_s
                y_m += vy_mps * dt_s
                angle_rad += turning_radps * dt_s
                middle_rad = angle_rad + half_rad
                vx_mps, vy_mps, turning_radps = (
                    forward_mps * cos(middle_rad),
                    forward_mps * sin(middle_rad),
                    omega_radps,
                )
        self.moved(x_m, y_m, angle_rad, vx_mps, vy_mps, turning_radps)
