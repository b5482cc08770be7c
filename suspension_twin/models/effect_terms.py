# SPDX-License-Identifier: Apache-2.0
"""What effects add to the full car within a step: one loop over the lanes for each.

Every term is exactly nothing for a lane whose constants of it are zero, and a block without such
a lane skips the loop. The first group changes the forces between ``corner.position_forces`` and
``corner.velocities``; the second comes after the velocities; the third between intervals.
"""

from __future__ import annotations

from typing import Final

from suspension_twin.arrays import Floats
from suspension_twin.compiled import compiled, inlined
from suspension_twin.models import rows
from suspension_twin.models.numerics import fma
from suspension_twin.models.rows import WIDTH

__all__ = [
    "FLAGS",
    "anti_roll_bars",
    "bending",
    "engine",
    "fade",
    "friction",
    "heat",
    "play",
    "progression",
    "retable",
    "stops",
    "viscous_tyres",
]

FRICTION: Final = 1
BUMP: Final = 2
REBOUND: Final = 4
BAR: Final = 8
TYRE_DAMPING: Final = 16
RETABLE: Final = 32
FADE: Final = 64
BEND: Final = 128
ENGINE: Final = 256
PROGRESSION: Final = 512
PLAY: Final = 1024

#: Which loops a block needs: bit, first row and number of rows that are not all zero then.
FLAGS: Final = (
    (FRICTION, rows.FRICTION_LIMIT, 4),
    (BUMP, rows.BUMP_RATE, 8),
    (REBOUND, rows.REBOUND_RATE, 8),
    (BAR, rows.BAR, 2),
    (TYRE_DAMPING, rows.TYRE_DAMPING, 2),
    (RETABLE, rows.MOUNT, 4),
    (RETABLE | FADE, rows.FADE_LOSS, 4),
    (BEND, rows.BEND_GAIN, 1),
    (ENGINE, rows.ENGINE_MASS, 1),
    (PROGRESSION, rows.RATE_RISE, 8),
    (PLAY, rows.PLAY, 4),
)


@inlined
def _out_of_static(w: Floats, i: int, c: int) -> float:
    """Compression in m of corner c's spring beyond its static one."""
    body = fma(-w[(rows.ARM_X + c // 2) * WIDTH + i], w[2 * WIDTH + i], w[i])
    compression = w[(3 + c) * WIDTH + i] - fma(w[(rows.ARM_Y + c) * WIDTH + i], w[1 * WIDTH + i], body)
    travel: float = compression - w[(rows.STATIC + c) * WIDTH + i]
    return travel


@inlined
def _rate(w: Floats, i: int, c: int) -> float:
    """Rate in m/s of corner c's compression, with the velocities as they stand."""
    body = fma(-w[(rows.ARM_X + c // 2) * WIDTH + i], w[9 * WIDTH + i], w[7 * WIDTH + i])
    rate: float = w[(10 + c) * WIDTH + i] - fma(w[(rows.ARM_Y + c) * WIDTH + i], w[8 * WIDTH + i], body)
    return rate


@compiled
def friction(w: Floats, h: float) -> None:
    """Dry friction: a spring that slips at its limit (Prandtl), so that a strut at rest can stick.

    Needs no velocity at the end of the step, has no stiffness beyond its own, cannot chatter.
    """
    for c in range(4):
        for i in range(WIDTH):
            limit = w[(rows.FRICTION_LIMIT + c) * WIDTH + i]
            rate = w[(rows.FRICTION_RATE + c) * WIDTH + i]
            f = fma(rate * h, _rate(w, i, c), w[(rows.FRICTION + c) * WIDTH + i])
            f = f if f < limit else limit
            f = f if f > -limit else -limit
            w[(rows.FRICTION + c) * WIDTH + i] = f
            w[(rows.STRUT + c) * WIDTH + i] += f


@compiled
def stops(w: Floats, gap: int, rate: int, rise: int, sign: float) -> None:
    """Stops at one end of travel, jounce with ``sign`` 1 and rebound with -1: progressive, elastic."""
    for c in range(4):
        for i in range(WIDTH):
            x = sign * _out_of_static(w, i, c) - w[(gap + c) * WIDTH + i]
            x = x if x > 0.0 else 0.0
            f = x * fma(w[(rise + c) * WIDTH + i], x, w[(rate + c) * WIDTH + i])
            w[(rows.STRUT + c) * WIDTH + i] += sign * f


@compiled
def progression(w: Floats) -> None:
    """Springs whose rate changes with travel x from static: a x + b x² more of it, so a x²/2 + b x³/3 more force."""
    for c in range(4):
        for i in range(WIDTH):
            x = _out_of_static(w, i, c)
            third = w[(rows.RATE_SQUARE + c) * WIDTH + i] / 3.0
            w[(rows.STRUT + c) * WIDTH + i] += (
                x * x * fma(third, x, 0.5 * w[(rows.RATE_RISE + c) * WIDTH + i])
            )


@compiled
def play(w: Floats, h: float) -> None:
    """Dampers that hold only once the play of their joints is taken up after a reversal.

    Where one is loose its force of the last step is taken away, which leaves what changes within a step: first
    order, while the dampers stay implicit.
    """
    for c in range(4):
        for i in range(WIDTH):
            half = w[(rows.PLAY + c) * WIDTH + i]
            y = fma(h, _rate(w, i, c), w[(rows.SLACK + c) * WIDTH + i])
            loose = w[(rows.DAMPER + c) * WIDTH + i] if abs(y) < half else 0.0
            y = y if y < half else half
            w[(rows.SLACK + c) * WIDTH + i] = y if y > -half else -half
            w[(rows.STRUT + c) * WIDTH + i] -= loose


@compiled
def anti_roll_bars(w: Floats) -> None:
    """An axle's left and right coupled: force by the difference of their compressions."""
    for a in range(2):
        for i in range(WIDTH):
            f = w[(rows.BAR + a) * WIDTH + i] * (
                _out_of_static(w, i, 2 * a) - _out_of_static(w, i, 2 * a + 1)
            )
            w[(rows.STRUT + 2 * a) * WIDTH + i] += f
            w[(rows.STRUT + 2 * a + 1) * WIDTH + i] -= f


@compiled
def viscous_tyres(w: Floats) -> None:
    """A tyre's damping, by how fast road and wheel come together in the middle of the step."""
    for c in range(4):
        for i in range(WIDTH):
            closing = w[(rows.ROAD_RATE + c) * WIDTH + i] - w[(10 + c) * WIDTH + i]
            w[(rows.GROUND + c) * WIDTH + i] += w[(rows.TYRE_DAMPING + c // 2) * WIDTH + i] * closing


@compiled
def engine(w: Floats, h: float) -> None:
    """The engine as a mass on soft mounts, out of the sprung mass that it was rigidly part of.

    With M the rigid body's inertia, m the engine's mass at g = (1, 0, -x), e its displacement
    against the body and f = m (omega² e + 2 zeta omega e') its mounts' force on the body,
    ``(M - m g g^T) q'' = Q + g f``; by Sherman and Morrison the rigid answer q0'' only gains
    ``M^-1 g (f + m g.q0'') / (1 - m g^T M^-1 g)``.
    """
    for i in range(WIDTH):
        mass, x = w[rows.ENGINE_MASS * WIDTH + i], w[rows.ENGINE_X * WIDTH + i]
        e, de = w[rows.ENGINE * WIDTH + i], w[(rows.ENGINE + 1) * WIDTH + i]
        e = fma(h, de, e)
        inv_m, inv_p = w[rows.INV_MASS * WIDTH + i], w[(rows.INV_MASS + 2) * WIDTH + i]
        give = fma(x * x, inv_p, inv_m)
        mount = fma(w[rows.ENGINE_STIFFNESS * WIDTH + i], e, w[rows.ENGINE_DAMPING * WIDTH + i] * de)
        az, ap = w[14 * WIDTH + i], w[16 * WIDTH + i]
        there = fma(-x, ap, az)
        f = mass * (mount + there) / (1.0 - mass * give)
        dz, dp = f * inv_m, -(x * f) * inv_p
        w[14 * WIDTH + i], w[16 * WIDTH + i] = az + dz, ap + dp
        w[7 * WIDTH + i], w[9 * WIDTH + i] = w[7 * WIDTH + i] + h * dz, w[9 * WIDTH + i] + h * dp
        dde = -mount - fma(give, f, there)
        w[rows.ENGINE * WIDTH + i], w[(rows.ENGINE + 1) * WIDTH + i] = e, fma(h, dde, de)
        w[(rows.ENGINE + 2) * WIDTH + i] = dde


@compiled
def bending(w: Floats, h: float) -> None:
    """One structural mode at the sensor, shaken by the body's heave; what it gives back is neglected."""
    for i in range(WIDTH):
        b, db = w[rows.BEND * WIDTH + i], w[(rows.BEND + 1) * WIDTH + i]
        b = fma(h, db, b)
        push = w[rows.BEND_GAIN * WIDTH + i] * w[14 * WIDTH + i]
        ddb = -fma(w[rows.BEND_STIFFNESS * WIDTH + i], b, fma(w[rows.BEND_DAMPING * WIDTH + i], db, push))
        w[rows.BEND * WIDTH + i], w[(rows.BEND + 1) * WIDTH + i] = b, fma(h, ddb, db)
        w[(rows.BEND + 2) * WIDTH + i] = ddb


@compiled
def heat(w: Floats, h: float) -> None:
    """What the dampers take up in a step."""
    for c in range(4):
        for i in range(WIDTH):
            power = abs(w[(rows.DAMPER + c) * WIDTH + i] * _rate(w, i, c))
            gain = fma(w[rows.FADE_ENERGY * WIDTH + i], power, w[rows.FADE_TIME * WIDTH + i])
            w[(rows.HEAT + c) * WIDTH + i] += h * gain


@compiled
def fade(w: Floats) -> None:
    """What heat leaves of the damping: 1 - loss q / (1 + q)."""
    for c in range(4):
        for i in range(WIDTH):
            q = w[(rows.HEAT + c) * WIDTH + i]
            w[(rows.FADE + c) * WIDTH + i] = 1.0 - w[(rows.FADE_LOSS + c) * WIDTH + i] * (q / (1.0 + q))


@compiled
def retable(w: Floats, h: float, hinges: int) -> None:
    """Build the corners' damper tables anew, for steps of ``h`` s, faded and with their mounts.

    A mount of compliance C in series with the damper gives way by C (F - F') within a step, which
    is as if beta were C / h larger. The arithmetic is that of ``constants``, so that a lane with
    neither keeps its table to the last bit.
    """
    points = hinges + 1
    for c in range(4):
        table = rows.CURVES + (2 + c) * (5 + 6 * hinges) + 2 + 2 * hinges
        master = rows.CURVES + 6 * (5 + 6 * hinges) + c * 6 * points
        for i in range(WIDTH):
            mount = w[(rows.MOUNT + c) * WIDTH + i]
            left = w[(rows.FADE + c) * WIDTH + i]
            beta = w[(rows.IMPLICIT + c // 2) * WIDTH + i] + mount / h
            w[(rows.CORNER_IMPLICIT + c) * WIDTH + i] = beta
            constant = 0.0
            first_push = 0.0
            for side in range(2):
                at = master + 3 * points * side
                sign = 1.0 - 2.0 * side
                slope = left * w[(at + 2 * points) * WIDTH + i]
                last = slope / (1.0 + beta * slope)
                if side == 0:
                    first_push = last
                else:
                    w[table * WIDTH + i] = last
                    w[(table + 1) * WIDTH + i] = first_push - last
                total = 0.0
                for j in range(hinges):
                    b = sign * (w[(at + j) * WIDTH + i] + beta * (left * w[(at + points + j) * WIDTH + i]))
                    slope = left * w[(at + 2 * points + j + 1) * WIDTH + i]
                    slope = slope / (1.0 + beta * slope)
                    change = slope - last
                    last = slope
                    w[(table + 3 + 2 * hinges * side + j) * WIDTH + i] = b
                    w[(table + 3 + 2 * hinges * side + hinges + j) * WIDTH + i] = change
                    total += b * change
                constant += total
            w[(table + 2) * WIDTH + i] = -constant
