"""Controls of a camera: exposure, gain and whatever else it has, as it describes them itself."""

from __future__ import annotations

import re
from collections.abc import Iterator, Mapping
from dataclasses import dataclass
from enum import Enum
from typing import Any

from linuxpy.ioctl import ioctl
from linuxpy.video import device as v4l2

from cmp_tactile_driver.v4l2.devices import device_error
from cmp_tactile_processing.errors import FrameSourceError

ControlValue = int | bool | str

ID, FLAG, TYPE = v4l2.ControlID, v4l2.ControlFlag, v4l2.ControlType
# Which automatic control rules which; the kernel says only that one of them does.
RULED_BY = {
    ID.EXPOSURE_ABSOLUTE: (ID.EXPOSURE_AUTO,),
    ID.EXPOSURE: (ID.EXPOSURE_AUTO, ID.AUTOGAIN),
    ID.GAIN: (ID.AUTOGAIN, ID.EXPOSURE_AUTO),
    ID.ANALOGUE_GAIN: (ID.AUTOGAIN, ID.EXPOSURE_AUTO),
    ID.ISO_SENSITIVITY: (ID.ISO_SENSITIVITY_AUTO,),
    ID.WHITE_BALANCE_TEMPERATURE: (ID.AUTO_WHITE_BALANCE,),
    ID.RED_BALANCE: (ID.AUTO_WHITE_BALANCE,),
    ID.BLUE_BALANCE: (ID.AUTO_WHITE_BALANCE,),
    ID.FOCUS_ABSOLUTE: (ID.FOCUS_AUTO,),
    ID.BRIGHTNESS: (ID.AUTOBRIGHTNESS,),
    ID.HUE: (ID.HUE_AUTO,),
}
RULERS = {ruler for rulers in RULED_BY.values() for ruler in rulers}


class ControlKind(Enum):
    """What values a control takes."""

    INTEGER = "integer"
    BOOLEAN = "boolean"
    MENU = "menu"
    BUTTON = "button"
    TEXT = "text"


KINDS = {
    TYPE.INTEGER: ControlKind.INTEGER,
    TYPE.INTEGER64: ControlKind.INTEGER,
    TYPE.BITMASK: ControlKind.INTEGER,
    TYPE.BOOLEAN: ControlKind.BOOLEAN,
    TYPE.MENU: ControlKind.MENU,
    TYPE.INTEGER_MENU: ControlKind.MENU,
    TYPE.BUTTON: ControlKind.BUTTON,
    TYPE.STRING: ControlKind.TEXT,
}


@dataclass(frozen=True)
class Control:
    """One control.  name: of the parameter.  title: what the camera calls it.

    low, high: of integers and menus, of a text its length.  choices: of a menu, number and text.
    fixed: can be read alone.  info: the structure of the kernel.
    """

    name: str
    title: str
    kind: ControlKind
    low: int
    high: int
    step: int
    choices: tuple[tuple[int, str], ...]
    fixed: bool
    info: Any

    @property
    def id(self) -> int:
        """The kernel's number."""
        return int(self.info.id)


class CameraControls:
    """The controls of an open linuxpy Device, by name."""

    def __init__(self, device: Any) -> None:
        self._device = device
        self._skipped: list[str] = []
        self.by_name: dict[str, Control] = {}
        for control in self._read():
            self.by_name[control.name] = control
            try:
                self.value(control.name)
            except FrameSourceError:
                self._skipped.append(self.by_name.pop(control.name).title)
        self._by_id = {item.id: item for item in self.by_name.values()}

    @property
    def skipped(self) -> tuple[str, ...]:
        """Titles of controls that cannot be read, or hold more than one value."""
        return tuple(self._skipped)

    def value(self, name: str) -> ControlValue:
        """What the camera has now; of what can only be written, its default.

        Raises FrameSourceError.
        """
        control = self._existing(name)
        info = control.info
        if control.kind is ControlKind.BUTTON:
            return False
        if info.flags & FLAG.WRITE_ONLY:
            value: Any = info.default_value
        else:
            try:
                (value,) = v4l2.get_controls_values(self._device, [info])
            except OSError as error:
                raise device_error(self._device.filename, control.name, error) from None
        if control.kind is ControlKind.TEXT:
            return str(value)
        return bool(value) if control.kind is ControlKind.BOOLEAN else int(value)

    def values(self) -> dict[str, ControlValue]:
        """All values; raises FrameSourceError."""
        return {name: self.value(name) for name in self.by_name}

    def obstacle(self, name: str) -> str:
        """Why a control cannot be set now, in words; empty where it can."""
        control = self.by_name[name]
        flags = self._flags(control)
        if flags & (FLAG.READ_ONLY | FLAG.DISABLED):
            return "found a read-only control: the camera sets it"
        if flags & FLAG.GRABBED:
            return "found it in use: set it while the node is inactive"
        if flags & FLAG.INACTIVE:
            return f"found it without effect {self._ruled_by(control)}"
        return ""

    def set(self, values: Mapping[str, ControlValue]) -> None:
        """Set all or none; automatic controls first, because others depend on them.

        Raises FrameSourceError naming the control and why it cannot be set.
        """
        done: dict[str, ControlValue] = {}
        for name in self._in_order(values):
            try:
                before = self.value(name)
                self._set_one(name, values[name])
            except FrameSourceError:
                self.restore(done)
                raise
            done[name] = before

    def restore(self, values: Mapping[str, ControlValue], *, also_equal: bool = False) -> list[str]:
        """Set what can be set, as after the camera was away; what could not be, in words.

        also_equal: set also what reads as if it were so already.
        """
        failures = []
        for name in self._in_order(values):
            control = self.by_name.get(name)
            if control is None or control.fixed or control.kind is ControlKind.BUTTON:
                continue
            try:
                if self._flags(control) & FLAG.INACTIVE:
                    continue
                if not also_equal and self.value(name) == values[name]:
                    continue
                self._set_one(name, values[name])
            # A text for what is a number now, of a camera with other firmware, is a ValueError.
            except (FrameSourceError, ValueError) as error:
                failures.append(str(error))
        return failures

    def kept_otherwise(self, values: Mapping[str, ControlValue]) -> list[str]:
        """Controls that have an effect now and are not as they were asked to be, in words.

        Rounding to the control's range and steps is none.  Raises FrameSourceError.
        """
        texts = []
        for name, wanted in values.items():
            control = self.by_name.get(name)
            if control is None or control.kind is ControlKind.BUTTON or self.obstacle(name):
                continue
            found = self.value(name)
            # With other firmware a menu may have become a number.
            if control.kind is ControlKind.INTEGER and not isinstance(wanted, str):
                nearest = min(max(int(wanted), control.low), control.high)
                is_kept = abs(int(found) - nearest) < max(control.step, 1)
            else:
                is_kept = found == wanted
            if not is_kept:
                texts.append(f"{name}: set to {wanted}, the camera uses {found}")
        return texts

    def _existing(self, name: str) -> Control:
        control = self.by_name.get(name)
        if control is None:
            msg = f"{self._device.filename}: {name}: found no such control"
            raise FrameSourceError(msg)
        return control

    def _in_order(self, names: Mapping[str, ControlValue]) -> list[str]:
        def is_ruled(name: str) -> bool:
            control = self.by_name.get(name)
            return control is None or not (control.id in RULERS or control.info.flags & FLAG.UPDATE)

        return sorted(names, key=is_ruled)

    def _set_one(self, name: str, value: ControlValue) -> None:
        control = self._existing(name)
        if control.kind is ControlKind.BUTTON and not value:
            return
        if obstacle := self.obstacle(name):
            msg = f"{self._device.filename}: {name}: {obstacle}"
            raise FrameSourceError(msg)
        if control.choices and value not in dict(control.choices):
            choices = ", ".join(f"{number}: {text}" for number, text in control.choices)
            msg = f"{self._device.filename}: {name}: found {value}, expected one of {choices}"
            raise FrameSourceError(msg)
        raw_value = value if control.kind is ControlKind.TEXT else int(value)
        try:
            v4l2.set_controls_values(self._device, [(control.info, raw_value)])
        except OSError as error:
            action = f"{name}: set to {value!r}"
            raise device_error(self._device.filename, action, error) from None

    def _flags(self, control: Control) -> int:
        query = v4l2.raw.v4l2_query_ext_ctrl(id=control.id)
        try:
            ioctl(self._device, v4l2.IOC.QUERY_EXT_CTRL, query)
        except OSError as error:
            raise device_error(self._device.filename, control.name, error) from None
        return int(query.flags)

    def _ruled_by(self, control: Control) -> str:
        rulers = [self._by_id.get(ruler) for ruler in RULED_BY.get(control.id, ())]
        texts = []
        for ruler in rulers:
            if ruler is not None:
                value = self.value(ruler.name)
                choice = dict(ruler.choices).get(int(value), "") if ruler.choices else ""
                texts.append(f"{ruler.name} is {value}" + (f" ({choice})" if choice else ""))
        return f"while {' and '.join(texts)}" if texts else "while an automatic control is active"

    def _read(self) -> Iterator[Control]:
        names: set[str] = set()
        for info in v4l2.iter_read_controls(self._device):
            if info.type == TYPE.CTRL_CLASS or info.flags & FLAG.DISABLED:
                continue
            title = info.name.decode(errors="replace")
            kind = KINDS.get(info.type)
            is_array = info.nr_of_dims or (
                info.flags & FLAG.HAS_PAYLOAD and info.type != TYPE.STRING
            )
            if kind is None or is_array:
                self._skipped.append(title)
                continue
            name = re.sub(r"[^a-z0-9]+", "_", title.lower()).strip("_") or f"control_{info.id:x}"
            if name in names:
                name = f"{name}_{info.id:x}"
            names.add(name)
            yield Control(
                name=name,
                title=title,
                kind=kind,
                low=info.minimum,
                high=info.maximum,
                step=info.step,
                choices=tuple(self._choices(info)) if kind is ControlKind.MENU else (),
                fixed=bool(info.flags & FLAG.READ_ONLY),
                info=info,
            )

    def _choices(self, info: Any) -> Iterator[tuple[int, str]]:
        item = v4l2.raw.v4l2_querymenu(id=info.id)
        numbers = {"start": info.minimum, "stop": info.maximum + 1}
        menu = v4l2.iter_read(self._device, v4l2.IOC.QUERYMENU, item, ignore_einval=True, **numbers)
        for entry in menu:
            is_text = info.type == TYPE.MENU
            text = entry.name.decode(errors="replace") if is_text else str(entry.value)
            yield entry.index, text
