"""What a recording says about one stream of messages."""

from dataclasses import dataclass


@dataclass(frozen=True, slots=True)
class Topic:
    """A topic of a recording.

    Attributes:
        name: its name.
        msgtype: message type in ROS 2 notation, ``package/msg/Type``.
        count: number of messages.
        ros1: whether messages are serialised as in ROS 1 instead of CDR.
    """

    name: str
    msgtype: str
    count: int
    ros1: bool


@dataclass(frozen=True, slots=True)
class Channel:
    """The stream that a salvaged message belongs to.

    Attributes:
        topic: its topic.
        msgtype: message type in ROS 2 notation, ``package/msg/Type``.
        definition: text of the message definition, empty where the file has none.
        idl: whether the definition is OMG IDL instead of a .msg file.
        ros1: whether messages are serialised as in ROS 1 instead of CDR.
    """

    topic: str
    msgtype: str
    definition: str
    idl: bool = False
    ros1: bool = False
