"""`cmp_tactile zero`, `call`: asks nodes that run for something, where there is no `ros2`."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Annotated, Any

from cmp_tactile_bringup.commands.options import Command, argument, option

# In which a force comes from a sensor that runs; one without is zeroed all the same.
FORCE_S = 3.0


@dataclass(frozen=True, kw_only=True)
class Zero(Command):
    """Set displacement and force of a running sensor to zero. Nothing may touch the gel. The next
    frames, for about half a second, are averaged. This calls the service
    stereo_triangulator/set_reference.

    The exit code is 1 if the zero was refused, for example under a load.
    """

    sensor: Annotated[
        str,
        argument(
            "[NAMESPACE]",
            "namespace of the sensor, or one of its topics; needed if several sensors run",
        ),
    ] = ""
    loaded: Annotated[bool, option("zero even if something presses on the gel")] = False

    def run(self) -> int:
        """Ask, and print the answer."""
        from std_srvs.srv import Trigger

        from cmp_tactile_bringup.commands.running_sensor import RunningSensorError, find_sensor
        from cmp_tactile_bringup.graphs.running import ZERO
        from cmp_tactile_processing.ros.process import Listener
        from cmp_tactile_processing.ros.services import SEARCH_S, answer_of

        with Listener("zero") as asking:
            space = find_sensor(asking.node, self.sensor).namespace
            load = "" if self.loaded else _load(asking.node, space)
            if load:
                msg = f"{space}: found {load}, expected nothing to touch the gel"
                raise RunningSensorError(f"{msg}; use --loaded to zero under this load")
            service = f"{space.rstrip('/')}/{ZERO}"
            answer = answer_of(asking.node, Trigger, service, Trigger.Request(), service_s=SEARCH_S)
        return _say(space, answer)


@dataclass(frozen=True, kw_only=True)
class Call(Command):
    """Call a service of a running node, or set parameters of a running node:

      cmp_tactile call replay/pause data:=true
      cmp_tactile call replay/step
      cmp_tactile call replay start:=4.5 rate:=0.5
      cmp_tactile call recorder/record data:=false

    The exit code is 1 if the call was refused. docs/nodes.md lists services and parameters; the
    error for an unknown name lists them, too.
    """

    name: Annotated[
        str,
        argument("SERVICE|NODE", "full name, or the end of it if only one name ends so"),
    ]
    values: Annotated[
        list[str] | None,
        argument("[NAME:=VALUE]", "fields of the request, or parameters of the node"),
    ] = None

    def run(self) -> int:
        """Call, and print the answer."""
        from cmp_tactile_processing.ros.process import Listener
        from cmp_tactile_processing.ros.services import call, find_service

        with Listener("call") as asking:
            service, kind = find_service(asking.node, self.name)
            answer = call(asking.node, service, kind, self.values or [])
        return _say(service, answer)


def _load(node: Any, namespace: str) -> str:
    """What presses on the gel, in words; "" where nothing does, or no force is known."""
    from math import hypot

    from cmp_tactile_msgs.msg import ForceField
    from cmp_tactile_processing.ros.services import settled

    fields: list[ForceField] = []
    topic = f"{namespace.rstrip('/')}/force_field"
    subscription = node.create_subscription(ForceField, topic, fields.append, 1)
    settled(lambda: bool(fields), FORCE_S)
    node.destroy_subscription(subscription)
    # What is measured against a wrong zero is no reason to keep that.
    if not fields or not fields[-1].contacts or fields[-1].flags & ForceField.FLAG_ZERO_DOUBTFUL:
        return ""
    force, count = fields[-1].wrench.force, len(fields[-1].contacts)
    contacts = "1 contact" if count == 1 else f"{count} contacts"
    return f"a load of {hypot(force.x, force.y, force.z):.2f} N ({contacts})"


def _say(asked: str, answer: Any) -> int:
    """Print what was answered; the exit code."""
    from cmp_tactile_processing.errors import printable
    from cmp_tactile_processing.ros.services import ServiceError

    fields = {name: getattr(answer, name) for name in answer.get_fields_and_field_types()}
    text = fields.pop("message", "") or fields.pop("reason", "")
    if not fields.pop("successful", fields.pop("success", True)):
        msg = f"{asked}: refused: {text or 'without a reason'}"
        raise ServiceError(msg)
    rest = [f"{name}: {value}" for name, value in fields.items() if value != ""]
    print(printable(f"{asked}: {', '.join(filter(None, [text, *rest])) or 'done'}"))
    return 0
