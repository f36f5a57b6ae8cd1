from collections.abc import Hashable

import pytest
from hypothesis import given
from hypothesis import strategies as st

from psiu_broker.frame import Address, Frame, Way
from psiu_broker.routing.outbox import COMMAND_LANE, QUESTION_LANE, STOP_LANE, Fate, Outbox, Parcel, lane

ARRIVED = Way("wifi")


def frame(subject: str = "parafrente", robot: str = "MNERIM", words: str = "") -> Frame:
    payload = f"{subject} {words}".rstrip().encode()
    return Frame(Address.named("PC"), Address.named(robot), subject, payload, "psiu-ascii")


def parcel(
    name: str, lane: int = COMMAND_LANE, expires: float = 10.0, peer: object = None, key: Hashable = None
) -> Parcel:
    return Parcel(name.encode(), peer, lane, 0.0, expires, Fate(frame(), ARRIVED), key=key)


def names(parcels: list[Parcel]) -> str:
    return " ".join(parcel.wire.decode() for parcel in parcels)


def taken(outbox: Outbox) -> str:
    out = []
    while (parcel := outbox.take()) is not None:
        out.append(parcel)
    return names(out)


def test_a_stop_overtakes_everything_and_a_question_waits_for_commands() -> None:
    outbox = Outbox()
    for item in (parcel("q", QUESTION_LANE), parcel("c1"), parcel("c2"), parcel("stop", STOP_LANE)):
        assert outbox.put(item) is None
    assert taken(outbox) == "stop c1 c2 q"


def test_the_words_decide_the_lane() -> None:
    assert lane(frame("pare")) == lane(frame("PARE")) == STOP_LANE
    assert lane(frame("parafrente")) == COMMAND_LANE
    assert lane(frame("node/4")) == COMMAND_LANE
    assert lane(frame("qualseunome")) == lane(frame("QualSeuNome")) == QUESTION_LANE


@pytest.mark.parametrize("status", ["sucesso", "falha", "OK"])
def test_the_answer_to_a_stop_is_no_stop(status: str) -> None:
    assert lane(frame("pare", "PC", status)) == COMMAND_LANE
    assert lane(frame("pare", "MNERIM", "agora")) == STOP_LANE


def test_a_stop_takes_out_what_would_move_its_robot_again_and_no_answer() -> None:
    outbox = Outbox()
    moves = [Fate(frame("parafrente", "MNERIM"), ARRIVED), Fate(frame("luz", "LAMP"), ARRIVED)]
    answer = Fate(frame("parafrente", "MNERIM", "sucesso"), ARRIVED)
    for fate in (*moves, answer):
        outbox.put(Parcel(b"", None, COMMAND_LANE, 0.0, 10.0, fate))
    stop = Parcel(b"", None, STOP_LANE, 0.0, 10.0, Fate(frame("pare", "MNERIM"), ARRIVED))
    assert [each.fate for each in outbox.overtaken(stop)] == [moves[0]]
    everyone = stop._replace(fate=Fate(frame("pare", "??"), ARRIVED))
    assert outbox.overtaken(everyone._replace(peer="another")) == []
    assert [each.fate for each in outbox.overtaken(everyone)] == [moves[1]]
    assert [each.fate for each in outbox] == [answer]


def test_a_newer_set_point_takes_the_place_of_the_older_and_has_its_own_age() -> None:
    outbox = Outbox(3)
    older = parcel("a1", key="a", expires=1.0)
    for item in (older, parcel("b1", key="b"), parcel("c")):
        outbox.put(item)
    newer = parcel("a2", key="a", expires=2.0)
    assert outbox.swap(newer) is older
    assert outbox.swap(parcel("d1", key="d")) is None
    assert outbox.expire(1.0) == []
    assert taken(outbox) == "a2 b1 c"


def test_what_a_limit_holds_back_is_passed_over_and_keeps_its_place() -> None:
    outbox = Outbox()
    for name in ("slow1", "quick", "slow2"):
        outbox.put(parcel(name))
    first = outbox.take(held=lambda parcel: parcel.wire.startswith(b"slow"))
    assert first is not None
    assert first.wire == b"quick"
    assert taken(outbox) == "slow1 slow2"


def test_only_what_is_as_urgent_is_waited_behind() -> None:
    outbox = Outbox()
    outbox.put(parcel("c", peer=1))
    assert outbox.waits_for(1, COMMAND_LANE)
    assert outbox.waits_for(1, QUESTION_LANE)
    assert not outbox.waits_for(1, STOP_LANE)
    assert not outbox.waits_for(2, QUESTION_LANE)


def test_when_full_the_oldest_of_the_least_urgent_goes() -> None:
    outbox = Outbox(2)
    outbox.put(parcel("old"))
    outbox.put(parcel("q", QUESTION_LANE))
    evicted = outbox.put(parcel("new"))
    assert evicted is not None
    assert evicted.wire == b"q"
    evicted = outbox.put(parcel("newest"))
    assert evicted is not None
    assert evicted.wire == b"old"
    assert taken(outbox) == "new newest"


def test_a_full_box_of_urgent_frames_turns_a_question_away() -> None:
    outbox = Outbox(1)
    outbox.put(parcel("stop", STOP_LANE))
    question = parcel("q", QUESTION_LANE)
    assert outbox.put(question) is question
    assert taken(outbox) == "stop"


def test_what_is_too_late_comes_out_instead_of_moving_a_robot() -> None:
    outbox = Outbox()
    outbox.put(parcel("late", expires=1.0))
    outbox.put(parcel("fresh", expires=2.0))
    assert names(outbox.expire(1.0)) == "late"
    assert taken(outbox) == "fresh"


def test_what_was_taken_and_refused_goes_back_to_the_head() -> None:
    outbox = Outbox()
    outbox.put(parcel("a"))
    outbox.put(parcel("b"))
    first = outbox.take()
    assert first is not None
    outbox.put_back(first)
    assert taken(outbox) == "a b"


def test_only_what_waits_for_a_lost_peer_is_removed() -> None:
    outbox = Outbox()
    outbox.put(parcel("a", peer=1))
    outbox.put(parcel("b", peer=2))
    assert names(outbox.remove_peer(1)) == "a"
    assert names(outbox.clear()) == "b"
    assert outbox.size == 0


def test_a_frame_that_went_two_ways_is_delivered_if_one_copy_was() -> None:
    fate = Fate(frame(), ARRIVED, 2)
    assert fate.settle("link_down") is None
    assert fate.settle("delivered") == "delivered"
    fate = Fate(frame(), ARRIVED, 2)
    assert fate.settle("link_down") is None
    assert fate.settle("expired") == "link_down"


steps = st.lists(
    st.one_of(
        st.tuples(st.just("put"), st.integers(0, 2), st.integers(0, 10), st.sampled_from([1, 2])),
        st.tuples(st.just("set"), st.integers(1, 3), st.integers(0, 10), st.sampled_from([1, 2])),
        st.tuples(st.just("take"), st.just(0), st.just(0), st.sampled_from([0, 1])),
        st.tuples(st.just("return"), st.just(0), st.just(0), st.sampled_from([0, 1])),
        st.tuples(st.just("expire"), st.just(0), st.integers(0, 10), st.just(0)),
        st.tuples(st.just("remove_peer"), st.just(0), st.just(0), st.sampled_from([1, 2])),
        st.tuples(st.just("stop"), st.just(0), st.just(10), st.sampled_from([1, 2])),
    ),
    max_size=60,
)


@given(steps, st.integers(1, 6))
def test_whatever_happens_nothing_is_lost_late_or_out_of_order(
    steps: list[tuple[str, int, int, int]], capacity: int
) -> None:
    """Each parcel comes out once; of a lane and a peer in order; none too late; of a set-point only the newest."""
    outbox = Outbox(capacity)
    every: list[Parcel] = []
    out: list[int] = []
    place: dict[int, int] = {}
    newest: dict[Hashable, Parcel] = {}
    gone_up_to: dict[tuple[int, object], int] = {}

    def put(item: Parcel) -> None:
        every.append(item)
        place.setdefault(id(item), len(every))
        evicted = outbox.put(item)
        if evicted is not None:
            assert evicted.lane == max(each.lane for each in (*outbox, evicted)), "the least urgent goes"
            out.append(id(evicted))

    def set_to(item: Parcel) -> None:
        newest[item.key] = item
        older = outbox.swap(item)
        if older is None:
            put(item)
        else:
            every.append(item)
            place[id(item)] = place[id(older)]
            out.append(id(older))

    for action, number, at, peer in steps:
        if action == "put":
            put(parcel("x", number, at, peer))
        elif action == "set":
            set_to(parcel("x", COMMAND_LANE, at, peer, key=(number, peer)))
        elif action == "stop":
            stop = parcel("stop", STOP_LANE, at, peer)
            out += map(id, outbox.overtaken(stop))
            put(stop)
            assert not any(each.lane == COMMAND_LANE and each.peer == peer for each in outbox)
        elif action in ("take", "return"):
            first = outbox.take({peer})
            if first is None:
                assert all(each.peer == peer for each in outbox)
            else:
                assert not any(each.lane < first.lane and each.peer != peer for each in outbox)
                if action == "return":
                    outbox.put_back(first)
                else:
                    assert gone_up_to.get((first.lane, first.peer), 0) < place[id(first)]
                    gone_up_to[first.lane, first.peer] = place[id(first)]
                    out.append(id(first))
        elif action == "expire":
            late = outbox.expire(at)
            assert all(each.expires <= at for each in late)
            assert all(each.expires > at for each in outbox)
            out += map(id, late)
        else:
            out += map(id, outbox.remove_peer(peer))
            assert not any(each.peer == peer for each in outbox)
        assert outbox.size == len(list(outbox)) <= capacity
        assert all(each is newest[each.key] for each in outbox if each.key is not None)
    out += map(id, outbox.clear())
    assert sorted(out) == sorted(map(id, every))
