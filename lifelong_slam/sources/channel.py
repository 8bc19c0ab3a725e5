"""What a recording says about one stream of messages."""

from dataclasses import dataclass

CDR, ROS1 = "cdr", "ros1"


@dataclass(frozen=True, slots=True)
class Topic:
    """A topic of a recording.

    Attributes:
        name: its name.
        msgtype: message type in ROS 2 notation, ``package/msg/Type``.
        count: number of messages.
        encoding: how messages are serialised: "ros1", "cdr", or what can't be read ("protobuf").
    """

    name: str
    msgtype: str
    count: int
    encoding: str

    @property
    def ros1(self) -> bool:
        """Whether messages are serialised as in ROS 1."""
        return self.encoding == ROS1

    @property
    def readable(self) -> bool:
        """Whether messages can be decoded."""
        return self.encoding in (CDR, ROS1)

    def __str__(self) -> str:
        kind = self.msgtype if self.readable else f"{self.msgtype} in {self.encoding}"
        return f"{self.name} ({kind}, {self.count} messages)"


@dataclass(frozen=True, slots=True)
class Channel:
    """The stream that a salvaged message belongs to.

    Attributes:
        topic: its topic.
        msgtype: message type in ROS 2 notation, ``package/msg/Type``.
        definition: text of the message definition, empty where the file has none.
        idl: whether the definition is OMG IDL instead of a .msg file.
        encoding: how messages are serialised, as in `Topic`.
    """

    topic: str
    msgtype: str
    definition: str
    idl: bool = False
    encoding: str = CDR

    @property
    def ros1(self) -> bool:
        """Whether messages are serialised as in ROS 1."""
        return self.encoding == ROS1
