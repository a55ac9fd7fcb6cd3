"""Types of ROS 2 messages as cyclonedds needs them, made from the definitions that rosbags has."""

from __future__ import annotations

from functools import cache
from typing import TYPE_CHECKING, Any

from torchcrf_scan.errors import TorchCRFScanError

if TYPE_CHECKING:
    from rosbags.typesys.store import Typestore

LASER, ODOMETRY = "sensor_msgs/msg/LaserScan", "nav_msgs/msg/Odometry"
MARKERS, OBSTACLES = "visualization_msgs/msg/MarkerArray", "nav2_dynamic_msgs/msg/ObstacleArray"
MARKER, OBSTACLE = "visualization_msgs/msg/Marker", "nav2_dynamic_msgs/msg/Obstacle"

EXTRA = {  # of the package nav2_dynamic_msgs, which rosbags does not have
    OBSTACLE: "unique_identifier_msgs/UUID uuid\nfloat32 score\ngeometry_msgs/Point position\n"
    "geometry_msgs/Vector3 velocity\ngeometry_msgs/Vector3 size\n",
    OBSTACLES: "std_msgs/Header header\nnav2_dynamic_msgs/Obstacle[] obstacles\n",
}
NUMBERS = ("int8", "uint8", "int16", "uint16", "int32", "uint32", "int64", "uint64", "float32", "float64")


@cache
def typestore() -> Typestore:
    """The definitions; raises TorchCRFScanError without rosbags."""
    try:
        from rosbags.typesys import Stores, get_types_from_msg, get_typestore
    except ImportError as error:
        raise TorchCRFScanError(f"listening: expected the library rosbags (extra `ros2`), got {error}") from error
    store = get_typestore(Stores.LATEST)
    for name, definition in EXTRA.items():
        store.register(get_types_from_msg(definition, name))
    return store


def type_hash(kind: str) -> str:
    """The hash by which ROS 2 (from Jazzy on) tells versions of a type apart."""
    return typestore().hash_rihs01(kind)


@cache
def struct(kind: str) -> type[Any]:
    """The class of a message, e.g. of sensor_msgs/msg/LaserScan: sensor_msgs::msg::dds_::LaserScan_."""
    from cyclonedds.idl import make_idl_struct

    package, folder, name = kind.split("/")
    fields = {key: _field_type(*form) for key, form in typestore().fielddefs[kind][1]}
    return make_idl_struct(f"{name}_", f"{package}.{folder}.dds_.{name}_", fields)


def _field_type(node: Any, detail: Any) -> Any:
    """The type of a field from rosbags' description of it: a base type, a message, an array or a sequence of these."""
    from cyclonedds.idl import types
    from rosbags.interfaces import Nodetype

    if node == Nodetype.NAME:
        return struct(detail)
    if node == Nodetype.BASE:
        name = {"byte": "uint8", "octet": "uint8", "char": "uint8"}.get(detail[0], detail[0])
        return getattr(types, name) if name in NUMBERS else {"string": str, "bool": bool}[name]
    length, made = detail[1], _field_type(*detail[0])
    many: Any = types.array if node == Nodetype.ARRAY else types.sequence
    return many[made, length] if length else many[made]


def new(kind: str, **fields: Any) -> Any:
    """A message; fields that are not given are zero or empty, dictionaries become messages."""
    forms = dict(typestore().fielddefs[kind][1])
    unknown = fields.keys() - forms.keys()
    assert not unknown, unknown
    return struct(kind)(**{key: _value(form, fields.get(key)) for key, form in forms.items()})


def _value(form: Any, given: Any) -> Any:
    from rosbags.interfaces import Nodetype

    node, detail = form
    if node == Nodetype.NAME:
        return given if isinstance(given, struct(detail)) else new(detail, **(given or {}))
    if node == Nodetype.BASE:
        return {"string": "", "bool": False}.get(detail[0], 0) if given is None else given
    inner, length = detail
    if given is None:
        return [_value(inner, None) for _ in range(length if node == Nodetype.ARRAY else 0)]
    return [_value(inner, one) for one in given] if inner[0] == Nodetype.NAME else given
