"""Who may do what on the bus, as rules for Zenoh. Nothing is allowed but what is said here.

Zenoh looks at the key of a message, and allows it where the key of a rule includes it whole: a put to ``psiu/**``
reaches every robot's callers, and no rule for less lets it pass. Of who is denied, nobody hears anything: its put is
gone, its get finds nobody, its token is not there.
"""

from collections.abc import Iterable, Mapping, Sequence
from typing import Final

from psiu_broker.config.tables import AccessConfiguration, ZenohConfiguration

HEARD: Final = ("**", "@raw/**", "@broker/*/conflicts")
"""What listeners and commanders may subscribe to."""

ASKED: Final = ("*", "@broker/*/*", "@broker/*/why/*/*")
"""What listeners and commanders may get. Every ``@broker/{broker}/{word}`` must be harmless: whatever makes a broker
or a robot do anything has another chunk, as ``trace/{a}/{b}`` and ``release/{robot}/{link}`` have."""

COMMANDED: Final = ("@call/*/*", "@broker/**")
"""What commanders may get besides; and put, of `CALLS`."""

CALLS: Final = ("@call/*/*",)

PROGRAMS: Final = ("@program/**",)
"""By what commanders are missed when they are gone."""

EVERYTHING: Final = ("**", "@alive/**", "@broker/**", "@call/**", "@mesh/**", "@program/**", "@raw/**")
"""All keys that brokers have: ``**`` covers none with an @."""

TRUNKS: Final = "unixsock-stream"
"""How trunks meet the session; with rules, nobody else does so."""

_ASKING: Final = ("query",)
_ANSWERING: Final = ("reply", "declare_queryable")
_TELLING: Final = ("put", "delete")
_HEARING: Final = ("declare_subscriber",)
_LIVING: Final = ("liveliness_token", "liveliness_query", "declare_liveliness_subscriber")

Rule = Mapping[str, object]


def access_control(zenoh: ZenohConfiguration, *, trunks: bool) -> Mapping[str, object] | None:
    """Zenoh's ``access_control`` for one broker; None where the configuration has no rules.

    Args:
        trunks: whether other brokers come by trunks too, where no certificate is shown.
    """
    access = zenoh.access
    if access is None:
        return None
    rules = list(_rules(zenoh.prefix))
    ids = [rule["id"] for rule in rules]
    subjects = [
        {"id": role, "cert_common_names": list(names)}
        for role in ("brokers", "commanders", "listeners")
        if (names := _names(access, role))
    ]
    roles = [subject["id"] for subject in subjects]
    if trunks:
        subjects.append({"id": "trunks", "link_protocols": [TRUNKS]})
        roles.append("trunks")
    of_role = {
        "brokers": ["broker"],
        "trunks": ["broker"],
        "commanders": [rule for rule in ids if rule != "broker"],
        "listeners": [rule for rule in ids if str(rule).startswith("listener")],
    }
    return {
        "enabled": True,
        "default_permission": "deny",
        "rules": rules,
        "subjects": subjects,
        "policies": [{"rules": of_role[str(role)], "subjects": [role]} for role in roles],
    }


def _names(access: AccessConfiguration, role: str) -> Sequence[str]:
    names: Sequence[str] = getattr(access, role)
    return names


def _rules(prefix: str) -> Iterable[Rule]:
    """Ingress is from the other program to us, egress to it."""

    def allow(name: str, flow: str, messages: Sequence[str], keys: Sequence[str]) -> Rule:
        return {
            "id": name,
            "permission": "allow",
            "flows": ["ingress", "egress"] if flow == "both" else [flow],
            "messages": list(messages),
            "key_exprs": [f"{prefix}/{key}" for key in keys],
        }

    yield allow("broker", "both", (*_TELLING, *_HEARING, *_ASKING, *_ANSWERING, *_LIVING), EVERYTHING)
    yield allow("listener-hears", "ingress", _HEARING, HEARD)
    yield allow("listener-is-told", "egress", _TELLING, HEARD)
    yield allow("listener-asks", "ingress", _ASKING, ASKED)
    yield allow("listener-is-answered", "egress", _ANSWERING, ASKED)
    yield allow("commander-asks", "ingress", _ASKING, COMMANDED)
    yield allow("commander-is-answered", "egress", (*_ANSWERING, *_HEARING), COMMANDED)
    yield allow("commander-puts", "ingress", ("put",), CALLS)
    yield allow("commander-is-there", "ingress", ("liveliness_token",), PROGRAMS)
