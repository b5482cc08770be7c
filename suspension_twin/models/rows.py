# SPDX-License-Identifier: Apache-2.0
"""Which row of a block holds what.

A block is one flat array of ``rows * WIDTH`` float64: row ``r`` of lane ``l`` is element
``r * WIDTH + l``. ``WIDTH`` is a constant of the source: with it the compiler sees that no two
rows overlap and turns the loop over lanes into vector instructions. Four rows in a row are the
four corners, two are front and rear. The curves come last, so that nothing moves when a curve
has more points; the rows of effects lie before them and are never touched where there are none.
"""

from __future__ import annotations

from typing import Final

__all__ = ["HINGES", "STATES", "WIDTH", "axle_rows", "block_rows", "corner_curves", "master_rows"]

#: Lanes of a block. One block's rows stay within the first-level cache; searches ask for a dozen lanes at a time more
#: often than for many, and twice the width would gain a twentieth where there are hundreds.
WIDTH: Final = 16
#: Stamps that one block walks before the next one does: what they write stays in the cache.
STRETCH: Final = 64

# -- state: displacement from standing on a level road at height 0, and its derivatives
#: Heave, roll, pitch, four wheels; a wheel's has its spring's static compression added, so that
#: the compression is what it is above the body.
POSITION: Final = 0
VELOCITY: Final = 7
ACCELERATION: Final = 14
DAMPER: Final = 21  # damper force at the last step, N
CONTACT: Final = 25  # tyre force at the last stamp, N
STATES: Final = 33  # so many rows are recorded; the last four mean something in msd alone
FAILED: Final = 29  # 0 while the lane is sound, 1 once it has diverged or could not stand
#: What the virtual sensor read at the last stamp: specific force 3, rate 3, vertical acceleration.
SIGNAL: Final = 30
STRUT: Final = 37  # within a step: strut force less the damper's, N (4)
GROUND: Final = 41  # within a step: tyre force before it is kept from pulling, N (4)
LAG: Final = 45  # within an interval: weight of the last damper force in the next, s/kg (4)
#: Within an interval: moments in roll and pitch of the planar accelerations at its beginning, and
#: what they gain until its end, N m.
MOMENT: Final = 49

# -- constants of a lane
INV_MASS: Final = 53  # 1 / sprung mass, roll inertia, pitch inertia
ARM_X: Final = 56  # wheels ahead of the sprung centre of gravity, m (2)
ARM_Y: Final = 58  # wheels to the left of it, m (4)
INV_WHEEL: Final = 62  # 1 / unsprung mass (2)
IMPLICIT: Final = 64  # beta of the damper tables, s/kg (2)
STATIC: Final = 66  # static compression of the springs, m (4)
LOAD: Final = 70  # static tyre load, N (4)
TOUCH: Final = 74  # tyre force on a road at height 0 of a wheel whose row of POSITION is 0, N (4)
TYRE: Final = 78  # tyre stiffness, N/m
TRANSFER: Final = 79  # mass times height of the centre of gravity, kg m
COG: Final = 80  # centre of gravity of the whole vehicle: x, y in base_link, m
SPRUNG: Final = 82  # centre of gravity of the sprung mass: x, y, z in base_link, m
SENSOR: Final = 85  # place of the virtual sensor in base_link, m

# -- state of effects
ROAD: Final = 88  # height under each wheel at this step, m (4)
ROAD_RATE: Final = 92  # and how fast it rises, m/s (4)
FRICTION: Final = 96  # force of the friction element, N (4)
HEAT: Final = 100  # what the dampers have taken up, in units of FADE_TIME/FADE_ENERGY (4)
FADE: Final = 104  # what is left of the damping, 1 when cold (4)
BEND: Final = 108  # body bending at the sensor: displacement, velocity, acceleration
ENGINE: Final = 111  # engine against the body: displacement, velocity, acceleration

# -- constants of effects; all zero where there are none
FRICTION_LIMIT: Final = 114  # dry friction, N (4)
FRICTION_RATE: Final = 118  # stiffness before it slips, N/m (4)
BUMP_GAP: Final = 122  # jounce from static until the stop touches, m (4)
BUMP_RATE: Final = 126  # first stiffness of the stop, N/m (4)
BUMP_RISE: Final = 130  # growth of its force with the square of its compression, N/m² (4)
REBOUND_GAP: Final = 134  # the same on the way out
REBOUND_RATE: Final = 138
REBOUND_RISE: Final = 142
BAR: Final = 146  # anti-roll bar: force per difference of compression, N/m (2)
TYRE_DAMPING: Final = 148  # N s/m (2)
MOUNT: Final = 150  # compliance in series with the damper, m/N (4)
FADE_LOSS: Final = 154  # share of the damping lost at last (4)
FADE_TIME: Final = 158  # growth of HEAT per second
FADE_ENERGY: Final = 159  # growth of HEAT per J taken up by a damper
BEND_STIFFNESS: Final = 160  # square of its angular frequency, 1/s²
BEND_DAMPING: Final = 161  # 2 zeta omega, 1/s
BEND_GAIN: Final = 162  # share of the body's acceleration that drives it
ENGINE_MASS: Final = 163  # kg
ENGINE_STIFFNESS: Final = 164  # square of its angular frequency on the mounts, 1/s²
ENGINE_DAMPING: Final = 165  # 2 zeta omega, 1/s
ENGINE_X: Final = 166  # ahead of the sprung centre of gravity, m
DAMPER_SCALE: Final = 167  # of each corner's damper, 0 for unchanged: factor - 1 (4)
SPRING_SCALE: Final = 171  # of each corner's spring, 0 for unchanged: factor - 1 (4)
UNSPRUNG: Final = 175  # mass of each wheel for msd, kg
RATE_RISE: Final = 176  # growth of each corner's spring rate with jounce from static, N/m² (4)
RATE_SQUARE: Final = 180  # and with its square, N/m³ (4)
PLAY: Final = 184  # half of the play in a damper's joints, m (4)
TERMS: Final = slice(114, 188)  # all constants of effects
CORNER_IMPLICIT: Final = 188  # beta of each corner's table (4)
SLACK: Final = 192  # state of effects: where in its play a damper is, m (4)

# -- rows of the model msd
WHEEL: Final = 196  # height of the wheels where they have a mass, m, its derivatives (12)
WEIGHT: Final = 208  # weight of the vehicle, N
SHARE: Final = 209  # share of the weight on each axle (2)
PITCH_SHIFT: Final = 211  # share that moves from front to rear for each m/s² ahead, s²/m
ROLL_SHIFT: Final = 212  # share of an axle's load that moves to the right for each m/s² left (2)
SIDE: Final = 214  # share of an axle's load that is more on the left than half of it (2)
INV_CORNER: Final = 216  # 1 / mass above each spring, 1/kg
INV_UNSPRUNG: Final = 217  # 1 / mass of each wheel, 0 where it has none

# -- one more constant of every lane
HEIGHT: Final = 218  # of the whole vehicle's centre of gravity above base_link, m

#: Curves of the axles with K hinges, front then rear: first slope and constant of the spring, K
#: abscissae and K changes of slope; then the damper's table: slope of the first pull segment,
#: change of slope at rest, constant, K abscissae and K changes of slope of push, and of pull.
CURVES: Final = 219
#: Kernels are compiled for these numbers of hinges; a curve of k points has k - 1.
HINGES: Final = (3, 7, 31)


def axle_rows(hinges: int) -> int:
    """Rows that the curves of one axle take, or, with effects, of one corner."""
    return 5 + 6 * hinges


def block_rows(hinges: int) -> int:
    """Rows of a block without effects."""
    return CURVES + 2 * axle_rows(hinges)


def corner_curves(hinges: int) -> int:
    """First row of the curves of the four corners in a block with effects, laid out as an axle's."""
    return block_rows(hinges)


def master_rows(hinges: int) -> int:
    """First row of the dampers as they are, for tables that change on the way.

    For each corner, push then pull: K + 1 speeds, K + 1 forces and K + 1 slopes.
    """
    return corner_curves(hinges) + 4 * axle_rows(hinges)


def effect_rows(hinges: int) -> int:
    """Rows of a block with effects."""
    return master_rows(hinges) + 4 * 2 * 3 * (hinges + 1)
