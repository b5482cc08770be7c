# SPDX-License-Identifier: Apache-2.0
"""A twin as URDF: body, sensors, and a joint for each wheel, as ``joint_states`` and ``/tf`` have them."""

from __future__ import annotations

from xml.etree import ElementTree as Xml

from suspension_twin.vehicle.corners import Joint
from suspension_twin.vehicle.twin import Place, Twin

__all__ = ["urdf", "wheel_frame"]

#: Range of the joints from their place at rest: m of a suspension, rad of an arm.
_TRAVEL = {"prismatic": 0.3, "revolute": 0.8}


def wheel_frame(joint: Joint) -> str:
    """Frame of the wheel at a joint: ``front_left_wheel`` at ``front_left_suspension``."""
    name = joint.name.removesuffix("_suspension")
    return name if "wheel" in name else f"{name}_wheel"


def urdf(twin: Twin, base: str = "base_link", prefix: str = "") -> str:
    """The robot description of a twin.

    Parameters
    ----------
    twin : Twin
        The twin; a model without joints gives the body and its sensors.
    base : str
        Name of the body's frame, prefix included.
    prefix : str
        In front of all other frames, such as ``car_1/``. Joints keep the names that ``joint_states`` has.

    Returns
    -------
    str
        XML. Lengths in m. Shapes for display and no masses: a twin is not simulated by its URDF.

    Examples
    --------
    >>> from suspension_twin.vehicle.twin import load_twin
    >>> text = urdf(load_twin("bags/bump_15kmh/twin.yaml"))
    >>> text.count('type="prismatic"'), "imu_link" in text
    (4, True)
    """
    robot = Xml.Element("robot", name=twin.vehicle.name)
    body = _link(robot, base)
    wheels = [joint.centre(joint.standing) for joint in twin.joints]
    if wheels:
        xs, ys = ([w[i] for w in wheels] for i in (0, 1))
        length, width = max(xs) - min(xs) + 1.5, 2 * max(map(abs, ys)) - 0.1
        middle = (max(xs) + min(xs)) / 2
        _shape(body, (middle, 0.0, 0.65), "box", size=_text((length, width, 0.5)))
        _shape(body, (middle - 0.3, 0.0, 1.15), "box", size=_text((0.5 * length, 0.85 * width, 0.5)))
    for joint in twin.joints:
        name = prefix + wheel_frame(joint)
        link = _link(robot, name)
        size = {"radius": f"{joint.radius:g}", "length": f"{joint.width:g}"}
        _shape(link, joint.wheel, "cylinder", rpy="1.5707963267948966 0 0", **size)
        element = _joint(robot, joint.name, joint.kind, (base, name), joint.origin)
        Xml.SubElement(element, "axis", xyz=_text(joint.axis))
        travel = _TRAVEL[joint.kind]
        lower, upper = joint.standing - travel, joint.standing + travel
        Xml.SubElement(element, "limit", lower=f"{lower:g}", upper=f"{upper:g}", effort="1e6", velocity="100")
    for place in (twin.imu, twin.gps):
        _sensor(robot, base, prefix, place)
    Xml.indent(robot)
    return Xml.tostring(robot, encoding="unicode")


def _sensor(robot: Xml.Element, base: str, prefix: str, place: Place) -> None:
    _link(robot, prefix + place.frame)
    links = base, prefix + place.frame
    _joint(robot, f"{place.frame}_joint", "fixed", links, place.position, place.rpy)


def _link(robot: Xml.Element, name: str) -> Xml.Element:
    return Xml.SubElement(robot, "link", name=name)


def _joint(
    robot: Xml.Element,
    name: str,
    kind: str,
    links: tuple[str, str],
    xyz: tuple[float, ...],
    rpy: tuple[float, ...] = (0.0, 0.0, 0.0),
) -> Xml.Element:
    element = Xml.SubElement(robot, "joint", name=name, type=kind)
    Xml.SubElement(element, "parent", link=links[0])
    Xml.SubElement(element, "child", link=links[1])
    Xml.SubElement(element, "origin", xyz=_text(xyz), rpy=_text(rpy))
    return element


def _shape(link: Xml.Element, xyz: tuple[float, ...], shape: str, rpy: str = "0 0 0", **size: str) -> None:
    visual = Xml.SubElement(link, "visual")
    Xml.SubElement(visual, "origin", xyz=_text(xyz), rpy=rpy)
    Xml.SubElement(Xml.SubElement(visual, "geometry"), shape, size)


def _text(values: tuple[float, ...]) -> str:
    return " ".join(f"{v:.9g}" for v in values)
