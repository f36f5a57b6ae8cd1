"""The messages that programs see on the bus, as pydantic models; `psiu schema` prints their JSON schema.

Fields are added, never renamed. Times are UTC, RFC 3339 with microseconds.
"""

from datetime import datetime
from typing import Annotated, Final, Literal

from pydantic import BaseModel, ConfigDict, Field, PlainSerializer, StrictFloat, StrictInt, StrictStr

from psiu_broker.errors import CallCode


def _rfc3339(moment: datetime) -> str:
    return moment.strftime("%Y-%m-%dT%H:%M:%S.%fZ")


Moment = Annotated[datetime, PlainSerializer(_rfc3339, return_type=str, when_used="json")]
Value = int | float | str
Kind = Literal[
    "command", "response", "ping", "ack", "nak", "busy", "available", "free", "wtf", "node", "complex", "event", "error"
]
"""What a frame is; event: something told unasked, as a sensor's value."""


BROKER_NAME_MAX: Final = 255
"""Letters in the name of a broker."""


class Message(BaseModel):
    """What all messages share: unknown fields of a newer broker are ignored."""

    model_config = ConfigDict(extra="ignore")


class Decoded(Message):
    """A frame that a robot sent, in words: ``psiu/{source}/{destination}/{subject}``."""

    source: str
    destination: str
    protocol: str
    kind: Kind
    command: str | None = Field(default=None, description="the command word or the node's name")
    parameters: list[Value] = []
    status: Literal["sucesso", "falha"] | None = None
    node: int | None = Field(default=None, description="PSIU HEXA: node number, 0 in a sensor's answer")
    signal: int | None = Field(default=None, description="PSIU HEXA: the node's signal byte, 0–255")
    value: float | None = Field(default=None, description="the signal in the unit of the node's declared type")
    unit: str | None = None
    fields: list[str] | None = Field(default=None, description="PSIU HEXA complex: the fields in hexadecimal")
    readings: dict[str, Value] = Field(default={}, description="several values told at once, by name: pins, sensors")
    remark: str | None = Field(
        default=None, description="what a tolerant codec forgave, such as a wrong size, or what it means in words"
    )
    broker: str
    link: str
    received: Moment
    wire: str = Field(description="the bytes on the wire, in hexadecimal")


class Command(Message):
    """One command of a robot, as `exibecomando` tells it: a name and how many parameters of each type."""

    name: str
    ints: int = 0
    floats: int = 0
    chars: int = 0
    minimum: int | None = None
    maximum: int | None = None
    unit: str | None = None
    description: str | None = Field(default=None, description="what it does, and what its parameters mean")
    aliases: list[str] = Field(default=[], description="other names for it: D for drive")


class Card(Message):
    """A robot that the broker knows: ``psiu/{robot}``."""

    robot: str
    address: str | None = Field(default=None, description="its PSIU HEXA address, where it has one")
    protocol: str
    broker: str
    link: str
    peer: str | None = None
    link_state: str
    first_heard: Moment | None = None
    last_heard: Moment | None = Field(default=None, description="null: configured but never heard")
    commands: list[Command] = []
    frames_heard: int = 0


class CallRequest(Message):
    """The payload of ``psiu/@call/{robot}/{command}``; none at all means no parameters."""

    model_config = ConfigDict(extra="forbid")

    # Strict: true is no number.
    parameters: list[StrictInt | StrictFloat | StrictStr] = Field(default=[], max_length=64)
    timeout_s: float | None = Field(default=None, gt=0, le=3600, strict=True)
    retries: int | None = Field(
        default=None, ge=0, le=100, strict=True, description="how often a question may be asked again"
    )
    program: str | None = Field(
        default=None,
        pattern=r"^[A-Za-z0-9_.-]+$",
        max_length=64,
        description="who calls, to be missed when it is gone: the last chunk of its liveliness token psiu/@program/…",
    )


class Answer(Message):
    """What a robot answered to a call."""

    status: Literal["sucesso", "falha"] | None = None
    values: list[Value] = []
    unit: str | None = None
    remark: str | None = Field(
        default=None, description="for a person: an error in words, or that robots do not answer"
    )
    elapsed_ms: float


class Refusal(Message):
    """Why a call has no answer from its robot: the payload of a Zenoh error reply."""

    error: CallCode
    message: str


class RawFrame(Message):
    """One frame of a link with what became of it: ``psiu/@raw/{broker}/{link}``."""

    direction: Literal["in", "out"]
    broker: str
    link: str
    peer: str | None = None
    source: str | None = None
    destination: str | None = None
    subject: str | None = None
    verdict: str
    detail: str | None = None
    received: Moment
    wire: str


class Link(Message):
    """One link: ``psiu/@broker/{broker}/links``."""

    name: str
    adapter: str
    protocol: str
    state: Literal["waiting", "opening", "open", "closed"]
    reason: str | None = Field(default=None, description="what it waits for, in words")
    since: Moment
    peers: list[str] = []
    robots: int = 0
    frames_in: int = 0
    frames_out: int = 0
    malformed: int = 0
    queued: int = 0
    delay_p50_ms: float | None = Field(
        default=None, description="how long the last 1000 frames sent had waited to leave; null: none was sent yet"
    )
    delay_p99_ms: float | None = None
    reopened: int = 0
    unasked: int = Field(
        default=0, description="questions of the broker's own not asked here, to leave the line to others"
    )
    last_heard: Moment | None = None
    details: dict[str, Value] = {}


class Trunk(Message):
    """One trunk: ``psiu/@broker/{broker}/trunks``."""

    name: str
    adapter: str
    state: Literal["waiting", "opening", "open", "closed"]
    reason: str | None = Field(default=None, description="what it waits for, in words")
    since: Moment
    far: str | None = Field(
        default=None, description="the broker at its far end, or those that called it, with spaces between"
    )
    bytes_in: int = 0
    bytes_out: int = 0
    overruns: int = Field(default=0, description="Zenoh connections given up because this broker did not read")


class Route(Message):
    """Where frames for a robot go: ``psiu/@broker/{broker}/routes``."""

    robot: str
    link: str
    peer: str | None = None
    origin: Literal["learned", "static", "mesh"] = Field(description="mesh: told by the broker that has the robot")
    age_s: float | None = Field(
        default=None, description="since its last checked frame; null for a static route never heard"
    )
    expires_in_s: float | None = None


class Account(Message):
    """What became of the frames that arrived on one link (or of the broker's own, link ``@self``)."""

    link: str
    arrived: int
    delivered: int
    answered: int
    dropped: dict[str, int] = Field(default={}, description="frames by reason")
    waiting: int = Field(default=0, description="in an outbox or held for a route at this moment")


class Ledger(Message):
    """The fate of every frame: ``psiu/@broker/{broker}/ledger``. arrived = delivered + answered + dropped + waiting."""

    accounts: list[Account]
    total: Account
    balances: bool = Field(description="every account, and the sum over all robots is the sum over all links")


class RobotAccount(Message):
    """What became of the frames that name one robot as their sender: ``psiu/@broker/{broker}/ledger-of-robots``."""

    robot: str | None = Field(
        default=None, description="null: what names nobody, and robots not heard of for so long that they are forgotten"
    )
    link: str | None = Field(default=None, description="where it is; @mesh: at another broker; null: nobody knows")
    arrived: int
    delivered: int
    answered: int
    dropped: dict[str, int] = Field(default={}, description="frames by reason")
    waiting: int = 0


class Status(Message):
    """The broker itself: ``psiu/@broker/{broker}/status``."""

    broker: str
    version: str
    started: Moment
    uptime_s: float
    links_open: int
    links: int
    robots: int
    zenoh_id: str
    listen: list[str]
    published: int = Field(default=0, description="messages put on the bus since it was opened")
    unpublished: int = Field(default=0, description="messages that could not be put")
    tasks: int = Field(default=0, description="what the broker does at the same time, as asyncio counts it")
    refused_puts: int = Field(default=0, description="commands put without waiting and refused: nobody was told")


class Health(Message):
    """What the watchdog looks at: ``psiu/@broker/{broker}/health``."""

    healthy: bool
    checks: dict[str, bool]


class Why(Message):
    """What the router would do with a frame from `a` to `b` now: ``psiu/@broker/{broker}/why/{a}/{b}``."""

    a: str
    b: str
    delivered: bool
    verdict: str
    steps: list[str] = Field(description="the decision, one sentence a step")
    broker: str = Field(default="", description="who says this")
    entry: str | None = Field(
        default=None,
        description="what a's frames come in on: a link, @self for the broker itself, @mesh from another broker;"
        " null: a is not known here",
    )
    via: str | None = Field(
        default=None, description="the broker that the frame is handed to next; null: to none; *: to several"
    )
    link: str | None = Field(default=None, description="what the frame leaves on; null: on none, or on several")
    age_s: float | None = Field(default=None, description="since b was last heard, as far as this broker knows")
    filter: str | None = Field(default=None, description="what could stop the frame here, or did")
    cost_ms: float | None = Field(
        default=None,
        description="what waits for the link now, and a frame of 40 bytes (PSIU HEXA: 6), on the wire;"
        " 0 where the wire is no limit",
    )


class MeshBroker(Message):
    """Another broker, as one broker sees it."""

    name: str
    zenoh_id: str
    since: Moment = Field(description="when it was first seen in this life of its own")
    rtt_ms: float | None = Field(default=None, description="there and back; null: not measured yet")
    silent_s: float | None = Field(default=None, description="since its last beat; null: none came yet")
    frames_in: int = 0
    frames_out: int = 0
    lost: int = Field(default=0, description="frames that it sent us and that never came")
    robots: int = Field(default=0, description="how many it owns")
    linked: bool = Field(default=False, description="whether Zenoh has a direct link to it; false: others relay")


class MeshRobot(Message):
    """A robot that a broker announces to the others."""

    robot: str
    address: str | None = Field(default=None, description="its PSIU HEXA address, where it has one")
    protocol: str
    owner: str = Field(description="the broker that publishes what it says and takes its calls")
    link: str
    quality: float = Field(description="how well it is heard there, 0–1")
    age_s: float | None = Field(default=None, description="since it was last heard; null: never")
    term: int = Field(description="grows with each change of owner; the highest is the owner's")


class Conflict(Message):
    """One name that more than one robot, or broker, seems to have: ``psiu/@broker/{broker}/conflicts``, put on change.

    Robots of one name are at several brokers, or on several links of one: `link` has the name then.
    """

    robot: str
    brokers: list[str]
    since: Moment
    detail: str = Field(description="what it means, and what to do")
    link: str | None = Field(default=None, description="which link keeps the name; null: it is among brokers")
    held_back: list[str] = Field(
        default=[], description="the links where whoever has the name too is neither listened to nor commanded"
    )
    frames: int = Field(default=0, description="how many frames were turned away there")
    last: Moment | None = Field(default=None, description="when the last of them was")


class Mesh(Message):
    """The brokers and their robots as one broker sees them: ``psiu/@broker/{broker}/mesh``."""

    broker: str
    mode: Literal["peer", "router"]
    zenoh_id: str
    brokers: list[MeshBroker] = Field(default=[], description="the others")
    robots: list[MeshRobot] = Field(default=[], description="all that are announced, its own among them")
    conflicts: list[Conflict] = []
    redeclared: int = Field(default=0, description="how often it announced everything again, to mend Zenoh's routes")
    unreadable: int = Field(
        default=0, description="what came from other brokers and is no beat, notice or announcement; frames: see Ledger"
    )


class TraceHop(Message):
    """Where a question was, and when."""

    at: str = Field(description="a broker, a broker's link such as base/radio, or the robot")
    event: Literal["sent", "routed", "received", "written", "answered"]
    elapsed_ms: float = Field(description="since the question left")


NOTHING: Final = "nothing"
"""What a robot was asked that cannot be asked anything without harm."""


class Trace(Message):
    """How a harmless question went from `a` to `b`: ``psiu/@broker/{broker}/trace/{a}/{b}``.

    Only the broker that has `a`, or is `a`, answers.
    """

    a: str
    b: str
    question: str = Field(description="the command that was sent; nothing: its protocol has no harmless one")
    answered: bool
    reason: str | None = Field(default=None, description="why there was no answer")
    hops: list[TraceHop] = []
    total_ms: float


PUBLISHED: Final[tuple[type[Message], ...]] = (
    Decoded,
    Card,
    CallRequest,
    Answer,
    Refusal,
    RawFrame,
    Link,
    Trunk,
    Route,
    Ledger,
    RobotAccount,
    Status,
    Health,
    Why,
    Mesh,
    Conflict,
    Trace,
)
"""The messages of the bus, in the order in which `psiu schema` prints them."""
