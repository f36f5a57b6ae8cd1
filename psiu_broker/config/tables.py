"""What may be written in the file, table by table, and what is made of it."""

import re
from collections.abc import Mapping
from dataclasses import dataclass, field
from typing import Annotated, Final, Literal, Self

from pydantic import AfterValidator, BaseModel, BeforeValidator, ConfigDict, Field, model_validator

from psiu_broker.adapter import Adapter, Peer
from psiu_broker.config.problems import got
from psiu_broker.frame import EVERYONE, Address
from psiu_broker.messages import BROKER_NAME_MAX
from psiu_broker.profiles.persona import PersonaOptions
from psiu_broker.profiles.profile import RobotOptions
from psiu_broker.routing.outbox import is_question


def robot_name(name: str) -> str:
    if not name.isascii() or not name.isprintable() or not name or name != name.strip():
        raise ValueError(f"expected a name of printable ASCII characters, got {got(name)}; choose a plain word")
    if str(EVERYONE) in name:
        raise ValueError(f"expected a name, got {got(name)}; ?? asks every robot, choose another word")
    if Address.parse(name).is_numbered:
        raise ValueError(f"expected a name, got {got(name)}, which reads as a PSIU HEXA address; choose a word")
    return name


def _broker_name(name: str) -> str:
    if " " in name:
        raise ValueError(
            f"expected a name without spaces, got {got(name)}: a robot that has not met it misreads it; choose one word"
        )
    if len(name) > BROKER_NAME_MAX:
        raise ValueError(
            f"expected a name of at most {BROKER_NAME_MAX} letters, got {len(name)}; choose a shorter word"
        )
    return robot_name(name)


def _endpoint(endpoint: str) -> str:
    match = ENDPOINT.fullmatch(endpoint)
    if match is None or int(match["port"] or 0) > 65535:
        raise ValueError(
            f"expected tcp/HOST:PORT (or tls/, udp/, ws/, unixsock-stream/PATH), got {got(endpoint)};"
            " write it like tcp/127.0.0.1:7447"
        )
    if match["port"] and int(match["port"]) == 0:
        raise ValueError(f"got {got(endpoint)}: port 0 is another one at each start; name one, 7447 is usual")
    return endpoint


def _endpoints(endpoints: tuple[str, ...]) -> tuple[str, ...]:
    if not endpoints:
        raise ValueError("expected at least one place, got none; leave listen out for tcp/127.0.0.1:7447")
    return _once(endpoints)


def _once(endpoints: tuple[str, ...]) -> tuple[str, ...]:
    for position, endpoint in enumerate(endpoints):
        if endpoint in endpoints[:position]:
            raise ValueError(f"{got(endpoint)} is there twice; remove one")
    return endpoints


def _prefix(prefix: str) -> str:
    if not re.fullmatch(r"[A-Za-z0-9_.-]+(/[A-Za-z0-9_.-]+)*", prefix):
        raise ValueError(f"expected words of letters, digits and _.- joined by /, got {got(prefix)}; psiu is usual")
    return prefix


def _losses(losses: tuple[str, ...]) -> tuple[str, ...]:
    if not losses:
        raise ValueError('expected at least one, got none; write on = ["program_gone"], or leave failsafe out')
    return _once(losses)


LINK_NAME: Final = re.compile(r"[A-Za-z0-9_-]+")
ENDPOINT: Final = re.compile(
    r"(?:tcp|tls|udp|ws)/(?P<host>\[[^\s\[\]]+\]|[^\s:/\[\]]+):(?P<port>[0-9]{1,5})(?:[?#]\S*)?|unixsock-stream/\S+"
)

BrokerName = Annotated[str, AfterValidator(_broker_name)]
Endpoint = Annotated[str, AfterValidator(_endpoint)]
Endpoints = Annotated[
    tuple[Endpoint, ...], AfterValidator(_endpoints), Field(json_schema_extra={"minItems": 1, "uniqueItems": True})
]
Others = Annotated[tuple[Endpoint, ...], AfterValidator(_once), Field(json_schema_extra={"uniqueItems": True})]
Prefix = Annotated[str, AfterValidator(_prefix)]
File = Annotated[str, Field(min_length=1)]
"""A path; where it is relative, from the folder of the configuration."""
Names = Annotated[
    tuple[Annotated[str, Field(min_length=1, max_length=64)], ...],
    AfterValidator(_once),
    Field(json_schema_extra={"uniqueItems": True}),
]
Commands = Annotated[
    tuple[Annotated[str, Field(min_length=1)], ...],
    AfterValidator(_once),
    Field(json_schema_extra={"uniqueItems": True}),
]
Number = Annotated[int, Field(ge=0, le=255)]
Seconds = Annotated[float, Field(gt=0, le=86400, allow_inf_nan=False)]


class _Table(BaseModel):
    model_config = ConfigDict(extra="forbid", frozen=True)


class BrokerConfiguration(_Table):
    """``[broker]``: who the broker is to robots, whose protocols it speaks as one of them."""

    name: BrokerName = Field(description="the broker's own name among the robots")
    address: Number = Field(0, description="the broker's own PSIU HEXA address")


class TlsConfiguration(_Table):
    """``[zenoh.tls]``: who the broker is to programs and other brokers, and whom it believes."""

    ca: File = Field(description="the certificate of the authority that made all the others")
    certificate: File = Field(description="the broker's own")
    key: File = Field(description="of the certificate; nobody else may read it")


class AccessConfiguration(_Table):
    """``[zenoh.access]``: who may do what, by the names in their certificates; who is not named may do nothing."""

    brokers: Names = Field((), description="other brokers, who may do everything")
    commanders: Names = Field((), description="who may call robots, and listen")
    listeners: Names = Field((), description="who may listen, and ask how things are")


class ZenohConfiguration(_Table):
    """``[zenoh]``: where other programs find the broker."""

    listen: Endpoints = Field(("tcp/127.0.0.1:7447",), description="where programs connect")
    prefix: Prefix = Field("psiu", description="the first part of every key")
    unprotected: bool = Field(False, description="let whoever reaches the broker from other computers do everything")
    tls: TlsConfiguration | None = Field(None, description="keys, for endpoints that begin with tls/")
    access: AccessConfiguration | None = Field(None, description="who may do what, by certificate")


class MeshConfiguration(_Table):
    """``[mesh]``: other brokers, and how they are reached. Others may connect to us all the same where it is absent."""

    mode: Literal["peer", "router"] = Field(
        "peer", description='"peer": every broker reaches every other; "router": Zenoh relays where they do not'
    )
    connect: Others = Field((), description="where other brokers listen; they may be down now")
    discover: bool = Field(False, description="find other brokers on the local network by multicast")


def _subject(pattern: str) -> str:
    if not re.fullmatch(r"[!-~]+", pattern):
        raise ValueError(
            f"expected one word, * for any letters, got {got(pattern)}; write it like parafrente or node/*"
        )
    return pattern


Subject = Annotated[str, AfterValidator(_subject)]
PerSecond = Annotated[float, Field(gt=0, le=1e9, allow_inf_nan=False)]


class SubjectLimit(_Table):
    """What may be written in ``limits.SUBJECT`` of a link."""

    model_config = ConfigDict(json_schema_extra={"minProperties": 1})

    frames_s: PerSecond | None = Field(None, description="so many such frames a second")
    bytes_s: PerSecond | None = Field(None, description="so many bytes of such frames a second")

    @model_validator(mode="after")
    def _is_limit(self) -> Self:
        if self.frames_s is None and self.bytes_s is None:
            raise ValueError("expected frames_s or bytes_s, got neither; write {frames_s = 10}, or leave it out")
        return self


def _glob(glob: str) -> str:
    if not glob.isascii() or not glob.isprintable() or glob != glob.strip() or not glob:
        raise ValueError(f"expected a name, in which * stands for any letters, got {got(glob)}; write it like MNERIM")
    return glob


def _several(globs: object) -> object:
    return tuple([globs] if isinstance(globs, str) else globs) if isinstance(globs, str | list) else globs


def _some(globs: tuple[str, ...]) -> tuple[str, ...]:
    if not globs:
        raise ValueError("expected at least one name, got none; leave it out for all")
    return globs


Glob = Annotated[str, AfterValidator(_glob)]
Globs = Annotated[
    tuple[Glob, ...],
    AfterValidator(_some),
    BeforeValidator(_several, json_schema_input_type=Glob | tuple[Glob, ...]),
]


class PolicyRule(_Table):
    """``[[policy]]``: who may command whom. The first rule that fits a command decides."""

    action: Literal["allow", "deny"] = Field(description="whether what fits the rest may pass")
    source: Globs = Field(
        ("*",), description="who commands: names, or globs such as PC*; programs on Zenoh: the broker"
    )
    destination: Globs = Field(("*",), description="who is commanded")
    command: Globs = Field(("*",), description="command words, or node/4 and the like, in any case")
    link: Globs = Field(("*",), description="where it comes in; @self: from programs on Zenoh, @mesh: from a broker")


class LinkOptions(_Table):
    """What may be written in every ``[links.NAME]``, whatever its adapter and protocol."""

    queue_frames: int = Field(64, ge=1, le=100_000, description="frames that may wait to be sent")
    max_age_s: Seconds = Field(2.0, description="a frame that waited longer is dropped: nothing late moves a robot")
    question_max_age_s: Seconds = Field(4.0, description="the same for questions about a robot, which move none")
    newest_wins: tuple[Subject, ...] = Field(
        (), description="subjects, such as node/*, of which only the newest for each robot waits to be sent"
    )
    max_frames_s: PerSecond | None = Field(None, description="frames sent a second, stops aside; more have to wait")
    max_bytes_s: PerSecond | None = Field(None, description="bytes sent a second, stops aside; more have to wait")
    limits: Mapping[Subject, SubjectLimit] = Field(
        {}, description="frames_s and bytes_s of a subject, such as node/*; the first that fits counts"
    )
    route_age_s: Seconds = Field(300.0, description="a robot not heard for so long is forgotten")
    timeout_s: Seconds = Field(2.0, description="how long a robot may take to answer, one try")
    retries: int = Field(2, ge=0, le=100, description="how often a question is asked again after silence")
    busy_poll_s: Seconds = Field(0.1, description="PSIU HEXA: how often a busy robot is asked AVAIL?")
    nak: bool | None = Field(None, description="PSIU HEXA: answer a bad CRC with NAK; left out: as the topology asks")
    avr_limits: bool = Field(False, description="the robots have an AVR's small buffers: warn before exceeding them")
    wildcard: bool = Field(True, description="frames to ?? are sent on this link")
    greet: bool = Field(True, description="ask who is there when the link opens")
    allow: tuple[Glob, ...] | None = Field(None, description="who may command from here, where no [[policy]] decides")
    deny: tuple[Glob, ...] = Field((), description="who may not command from here, where no [[policy]] decides")
    new_names_per_minute: int = Field(
        30, ge=1, le=100_000, description="robots heard here for the first time; of more only stops are listened to"
    )
    plays: str | None = Field(None, description="the robot that programs at the far end find there, and command")
    proxy_errors: bool = Field(
        False, description="PSIU ASCII: answer falha for a robot that cannot be reached; no other broker may be here"
    )

    def longest_wait_s(self, command: str) -> float:
        """How old a frame with that command word may be when it is sent."""
        return self.question_max_age_s if is_question(command) else self.max_age_s


Loss = Literal["program_gone", "link_silent", "broker_stop"]
"""What may happen to a robot that moves: the program that moved it last is gone; nothing more comes from the robot, or
its link is down; the broker stops."""


class FailsafeConfiguration(_Table):
    """``[robots.NAME.failsafe]``: what stops a robot that somebody moved and that is left alone."""

    command: Annotated[str, Field(min_length=1)] = Field(description="what stops it")
    parameters: tuple[int | float | str, ...] = Field((), max_length=64, description="of the command")
    on: Annotated[tuple[Loss, ...], AfterValidator(_losses), Field(json_schema_extra={"minItems": 1})] = Field(
        ("program_gone", "broker_stop"), description="when"
    )
    silent_s: Seconds = Field(5.0, description='with "link_silent": how long nothing may come from the robot')


class RobotTable(_Table):
    """What may be written in every ``[robots.NAME]``, whatever the protocol of its link."""

    link: str = Field(description="the name of its link")
    address: Number | None = Field(None, description="its address, where its protocol knows robots by numbers")
    peer: str | None = Field(None, description='where it is on its link; "host:port" over UDP')
    repeatable: Commands = Field((), description="commands that are told again after silence, as questions are")
    failsafe: FailsafeConfiguration | None = Field(None, description="what stops it when nobody is left who could")


@dataclass(frozen=True, slots=True)
class LinkConfiguration:
    """One link: how it is opened, what is spoken on it, and how it is kept."""

    name: str
    adapter_name: str
    adapter: Adapter
    protocol: str
    codec: BaseModel
    """The `Options` of ``CODECS[protocol]``."""
    options: LinkOptions
    map: PersonaOptions | None = None
    """What the robot that `options.plays` names looks like there, in the `Persona.Options` of the protocol."""


def domain_of(link: LinkConfiguration) -> str:
    """Within what the numbers of a link's robots are unique: what the user says, or the link itself."""
    return str(getattr(link.codec, "domain", link.name))


@dataclass(frozen=True, slots=True)
class TrunkConfiguration:
    """A reliable stream that carries the Zenoh session to another broker, and how it is opened."""

    name: str
    adapter_name: str
    adapter: Adapter


@dataclass(frozen=True, slots=True)
class RobotConfiguration:
    """A robot that the user named: where it is, its address where it has one, and what its profile is to know."""

    name: str
    link: str
    protocol: str
    address: Address | None
    peer: Peer
    """As the link's adapter knows it, ``(host, port)`` over UDP; None where the file leaves it out."""
    options: RobotOptions
    """The `Options` of its protocol's profile."""
    repeatable: frozenset[str] = frozenset()
    """Its commands that may be sent again although the robot may have carried them out."""
    failsafe: FailsafeConfiguration | None = None


@dataclass(frozen=True, slots=True)
class Configuration:
    """A whole configuration that can work; `warnings` are lines for the user about what is allowed but risky."""

    broker: BrokerConfiguration
    zenoh: ZenohConfiguration
    links: Mapping[str, LinkConfiguration]
    robots: Mapping[str, RobotConfiguration]
    warnings: tuple[str, ...] = ()
    trunks: Mapping[str, TrunkConfiguration] = field(default_factory=dict)
    mesh: MeshConfiguration = field(default_factory=MeshConfiguration)
    policy: tuple[PolicyRule, ...] = ()
