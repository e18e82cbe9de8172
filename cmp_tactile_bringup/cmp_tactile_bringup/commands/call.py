"""`cmp_tactile zero`, `call`: asks nodes that run for something, where there is no `ros2`."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Annotated, Any

from cmp_tactile_bringup.commands.options import Command, argument, option

# In which a force comes from a sensor that runs; one without is zeroed all the same.
FORCE_S = 3.0


@dataclass(frozen=True, kw_only=True)
class Zero(Command):
    """Count displacement and force of a sensor that runs from now on, with nothing touching the
    gel. It averages the next frames, half a second or so. This is the service
    stereo_triangulator/set_reference of its nodes.

    The exit code is 1 where the zero was refused, as under a load.
    """

    sensor: Annotated[
        str, argument("[NAMESPACE]", "of the sensor, or one of its topics, where several run")
    ] = ""
    loaded: Annotated[bool, option("also while something presses on the gel")] = False

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
                msg = f"{space}: found {load}, expected a gel that nothing touches"
                raise RunningSensorError(f"{msg}; --loaded zeroes all the same")
            service = f"{space.rstrip('/')}/{ZERO}"
            answer = answer_of(asking.node, Trigger, service, Trigger.Request(), service_s=SEARCH_S)
        return _say(space, answer)


@dataclass(frozen=True, kw_only=True)
class Call(Command):
    """Call a service of nodes that run, or set parameters of one of them:

      cmp_tactile call replay/pause data:=true
      cmp_tactile call replay/step
      cmp_tactile call replay start:=4.5 rate:=0.5
      cmp_tactile call recorder/record data:=false

    The exit code is 1 where it was refused. What there is stands in docs/nodes.md; a name that is
    not found lists it, too.
    """

    name: Annotated[
        str,
        argument("SERVICE|NODE", "its name, or the end of it where no other ends so"),
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
