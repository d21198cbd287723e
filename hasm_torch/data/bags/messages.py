"""Definitions of the messages that ROS does not ship, for bags that do not carry them.

ROS 1 bags and newer ROS 2 bags carry the definitions of what they hold, which then count.
"""

from typing import Any

# As their packages publish them (the MD5 of the array of skin cells is that of its package). The
# package of Xela's sensors documents taxels as int16, but sends up to 65535.
_SKIN_CELL = """
int32 cellId
int64 ts
float64[] prox
float64[] force
float64[] acc
float64[] temp
"""
_XELA = {
    "Taxel": "uint16 x\nuint16 y\nuint16 z\n",
    "Forces": "float32 x\nfloat32 y\nfloat32 z\n",
    "SensorFull": "uint32 message\nfloat64 time\nstring model\nuint8 sensor_pos\n"
    "Taxel[] taxels\nForces[] forces\n",
    "SensStream": "SensorFull[] sensors\n",
}
XELA_STREAMS = (
    "xela_server_ros/msg/SensStream",
    "xela_server_ros2/msg/SensStream",
    "xela_server/msg/XStream",  # of earlier versions
)


def definitions() -> dict[str, str]:
    """The text of each definition, by the message's name."""
    texts = {
        "tum_ics_skin_msgs/msg/SkinCellData": _SKIN_CELL,
        "tum_ics_skin_msgs/msg/SkinCellDataArray": "SkinCellData[] data\n",
        "tactile_msgs/msg/TactileState": "std_msgs/Header header\n"
        "sensor_msgs/ChannelFloat32[] sensors\n",
    }
    for stream in XELA_STREAMS:
        package, _, name = stream.rpartition("/")
        for own, text in _XELA.items():
            texts[f"{package}/{name if own == 'SensStream' else own}"] = text
    return texts


def typestore(ros1: bool = False) -> Any:
    """A typestore of ``rosbags`` with the messages of ROS and of the skins.

    Args:
        ros1: Of ROS 1; else of ROS 2.
    """
    from rosbags.typesys import Stores, get_types_from_msg, get_typestore

    store = get_typestore(Stores.ROS1_NOETIC if ros1 else Stores.ROS2_HUMBLE)
    for name, text in definitions().items():
        store.register(get_types_from_msg(text, name))
    return store
