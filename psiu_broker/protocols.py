"""Every protocol that the broker speaks, an entry each: a codec, a profile and, where there is one, a persona."""

from collections.abc import Callable, Mapping
from dataclasses import dataclass
from typing import Any, Final

from psiu_broker.codecs.amarino import Amarino
from psiu_broker.codecs.codec import Codec
from psiu_broker.codecs.firmata import Firmata
from psiu_broker.codecs.mitya import Mitya
from psiu_broker.codecs.psiu_ascii import PsiuAscii
from psiu_broker.codecs.psiu_hexa import PsiuHexa
from psiu_broker.codecs.soccer import Soccer
from psiu_broker.profiles.amarino import AmarinoProfile
from psiu_broker.profiles.amarino_persona import AmarinoPersona
from psiu_broker.profiles.firmata import FirmataProfile
from psiu_broker.profiles.firmata_persona import FirmataPersona
from psiu_broker.profiles.hexa import HexaProfile
from psiu_broker.profiles.mitya_persona import MityaPersona
from psiu_broker.profiles.persona import Persona
from psiu_broker.profiles.profile import Profile
from psiu_broker.profiles.psiu import PsiuProfile
from psiu_broker.profiles.roboscript import ScriptedMitya
from psiu_broker.profiles.soccer import SoccerProfile


@dataclass(frozen=True, slots=True)
class Protocol:
    """What the broker needs in order to speak one protocol."""

    codec: type[Codec]
    profile: type[Profile]
    """Its robots, as callers see them."""
    persona: type[Persona] | None = None
    """Such a robot, played to a program; None: only robots of this very protocol can be played in it."""
    numbers: Callable[[Any], range] | None = None
    """The addresses that its robots may have, told the options of the codec; None: they have names only."""


PROTOCOLS: Final[Mapping[str, Protocol]] = {
    "psiu-ascii": Protocol(PsiuAscii, PsiuProfile),
    "psiu-hexa": Protocol(PsiuHexa, HexaProfile, numbers=lambda _: range(256)),
    "mitya": Protocol(Mitya, ScriptedMitya, MityaPersona),
    "soccer": Protocol(Soccer, SoccerProfile, numbers=lambda options: range(1, options.robots + 1)),
    "firmata": Protocol(Firmata, FirmataProfile, FirmataPersona),
    "amarino": Protocol(Amarino, AmarinoProfile, AmarinoPersona),
}
"""Every protocol by the name that the user writes as ``protocol``."""

CODECS: Final[Mapping[str, type[Codec]]] = {name: protocol.codec for name, protocol in PROTOCOLS.items()}
