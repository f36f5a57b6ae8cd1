"""What other brokers announce is hostile until checked."""

from types import SimpleNamespace
from typing import Any

import pytest
import zenoh
from hypothesis import given
from hypothesis import strategies as st

from psiu_broker.bus.keys import Keys
from psiu_broker.bus.mesh import ZenohMesh
from psiu_broker.errors import EncodeError
from psiu_broker.frame import Address, Frame, Way
from psiu_broker.mesh.envelope import Envelope, pack
from psiu_broker.routing.claims import TERM_MAX, Claim, Claims
from psiu_broker.routing.router import SELF, Router
from psiu_broker.routing.table import Route

GOOD_BROKER = "psiu/@mesh/broker/base/5/b10c/0"
GOOD_ROBOT = "psiu/@mesh/robot/base/5/MNERIM/-/psiu-ascii/radio/3/10/30/0"


class Worker:
    def worker(self, name: str) -> None: ...

    zenoh_id = "a"


@pytest.fixture
def mesh() -> ZenohMesh:
    session: Any = Worker()
    nobody: Any = SimpleNamespace()
    return ZenohMesh(session, Keys(), "own", nobody)


def sample(key: str) -> Any:
    return SimpleNamespace(key_expr=key, kind=zenoh.SampleKind.PUT)


def read(mesh: ZenohMesh, key: str) -> object:
    """What the reader's thread makes of a token: None or an error, which the bridge logs, for one that is wrong."""
    parse = mesh._broker_token if "/broker/" in key else mesh._robot_token
    try:
        return parse(sample(key))
    except ValueError:
        return None


def test_good_tokens_are_read(mesh: ZenohMesh) -> None:
    assert read(mesh, GOOD_BROKER) is not None
    assert read(mesh, GOOD_ROBOT) is not None


@pytest.mark.parametrize("epoch", ["-1", str(2**64), "1" * 5000, "1_0", "+1", "", "٣"])
def test_an_epoch_that_no_envelope_can_carry_is_refused(mesh: ZenohMesh, epoch: str) -> None:
    assert read(mesh, GOOD_BROKER.replace("/5/", f"/{epoch}/")) is None
    assert read(mesh, GOOD_ROBOT.replace("/5/", f"/{epoch}/")) is None


@pytest.mark.parametrize("term", ["-1", "9" * 4300, str(TERM_MAX)])
def test_a_term_without_end_is_refused(mesh: ZenohMesh, term: str) -> None:
    assert read(mesh, GOOD_ROBOT.replace("/3/10/", f"/{term}/10/")) is None


@pytest.mark.parametrize("name", ["%", "%3F%3F", "x" * 300])
def test_a_broker_without_a_name_of_its_own_is_refused(mesh: ZenohMesh, name: str) -> None:
    assert read(mesh, GOOD_BROKER.replace("/base/", f"/{name}/")) is None


@given(st.lists(st.text(alphabet="ab/%0123456789-@*", max_size=8), max_size=12))
def test_no_key_raises_anything_but_what_the_reader_expects(chunks: list[str]) -> None:
    session: Any = Worker()
    nobody: Any = SimpleNamespace()
    made = ZenohMesh(session, Keys(), "own", nobody)
    for word in ("broker", "robot"):
        read(made, f"psiu/@mesh/{word}/" + "/".join(chunks))


class Tokens:
    """In the place of a session whose liveliness refuses the keys with `refused` in them."""

    def __init__(self) -> None:
        self.refused = "nothing"
        self.stand: list[str] = []
        self.zenoh_id = "a"
        self.zenoh = SimpleNamespace(liveliness=lambda: self)

    def worker(self, name: str) -> None: ...

    def panicked(self, error: BaseException) -> bool:
        return False

    def declare_token(self, key: str) -> Any:
        if self.refused in key:
            raise zenoh.ZError("not now")
        self.stand.append(key)
        return SimpleNamespace(undeclare=lambda: self.stand.remove(key))


def test_a_token_that_cannot_be_declared_anew_stays_and_costs_no_other_its_own() -> None:
    session, nobody = Tokens(), SimpleNamespace()
    made = ZenohMesh(session, Keys(), "own", nobody)  # type: ignore[arg-type]
    for key in "abc":
        made._declare(key)
    session.refused = "b/"
    made._declare_tokens_anew()
    assert sorted(session.stand) == ["a/1", "b/0", "c/1"]
    session.refused = "nothing"
    made._declare_tokens_anew()
    assert sorted(session.stand) == ["a/2", "b/2", "c/2"]
    made._undeclare("b")
    assert sorted(session.stand) == ["a/2", "c/2"]


def test_a_token_that_could_not_be_declared_is_when_all_are_declared_anew() -> None:
    session, nobody = Tokens(), SimpleNamespace()
    made = ZenohMesh(session, Keys(), "own", nobody)  # type: ignore[arg-type]
    session.refused = "b/"
    for key in "abc":
        made._guarded(made._declare, key)
    session.refused = "nothing"
    made._declare_tokens_anew()
    assert sorted(session.stand) == ["a/1", "b/1", "c/1"]


def test_terms_come_to_an_end_rather_than_break() -> None:
    claims = Claims()
    robot = Address.named("MNERIM")
    claims.set("base", Claim(robot, None, "psiu-ascii", "radio", TERM_MAX - 1, 10, 0))
    assert claims.next_term(robot) == TERM_MAX - 1


def test_an_envelope_that_cannot_be_said_is_an_encode_error() -> None:
    frame = Frame(Address.named("A"), Address.named("B"), "oi", b"oi", "psiu-ascii")
    with pytest.raises(EncodeError):
        pack(Envelope(-1, 0, 1, 0, 0, frame))


def test_nobody_takes_the_brokers_own_number() -> None:
    own = Address.numbered(0)
    router = Router({own: "psiu-hexa"}, (), identity=lambda frame: frame.wire)
    router.announced((Address.named("BRACO"), own), Way("@mesh", "other"), "psiu-hexa", 1.0)
    found = router.find(own)
    assert isinstance(found, Route)
    assert found.way == SELF
