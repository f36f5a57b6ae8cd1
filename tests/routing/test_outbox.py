from collections.abc import Hashable
from itertools import count

import pytest
from hypothesis import given
from hypothesis import strategies as st

from psiu_broker.frame import Address, Frame, Way
from psiu_broker.routing.outbox import COMMAND_LANE, QUESTION_LANE, STOP_LANE, Fate, Outbox, Parcel, lane

ARRIVED, CABLE, RADIO = Way("wifi"), Way("cable"), Way("radio")


def frame(subject: str = "parafrente", robot: str = "MNERIM", words: str = "") -> Frame:
    payload = f"{subject} {words}".rstrip().encode()
    return Frame(Address.named("PC"), Address.named(robot), subject, payload, "psiu-ascii")


def parcel(
    name: str,
    lane: int = COMMAND_LANE,
    expires: float = 10.0,
    peer: object = None,
    key: Hashable = None,
    way: Way = ARRIVED,
) -> Parcel:
    return Parcel(name.encode(), peer, lane, 0.0, expires, Fate(frame(), way), key=key)


def stop(name: str, way: Way = ARRIVED, key: Hashable = None) -> Parcel:
    return parcel(name, STOP_LANE, way=way, key=key)


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
    mnerim = Parcel(b"", None, STOP_LANE, 0.0, 10.0, Fate(frame("pare", "MNERIM"), ARRIVED))
    assert [each.fate for each in outbox.overtaken(mnerim)] == [moves[0]]
    everyone = mnerim._replace(fate=Fate(frame("pare", "??"), ARRIVED))
    assert outbox.overtaken(everyone._replace(peer="another")) == []
    assert [each.fate for each in outbox.overtaken(everyone)] == [moves[1]]
    assert [each.fate for each in outbox] == [answer]


def test_a_stop_takes_out_what_would_move_everyone_with_its_robot_on_that_far_end() -> None:
    outbox = Outbox()
    moves = {peer: Fate(frame("parafrente", "??"), ARRIVED) for peer in ("hers", "his")}
    question = Fate(frame("qualseunome", "??"), ARRIVED)
    for peer, fate in moves.items():
        outbox.put(Parcel(b"", peer, COMMAND_LANE, 0.0, 10.0, fate))
    outbox.put(Parcel(b"", "hers", QUESTION_LANE, 0.0, 10.0, question))
    hers = Parcel(b"", "hers", STOP_LANE, 0.0, 10.0, Fate(frame("pare", "MNERIM"), ARRIVED))
    assert [each.fate for each in outbox.overtaken(hers)] == [moves["hers"]]
    assert [each.fate for each in outbox] == [moves["his"], question]


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


def test_stops_leave_by_turns_of_the_ways_by_which_they_came() -> None:
    outbox = Outbox()
    for item in (
        stop("e1"),
        stop("e2"),
        stop("e3"),
        stop("c1", CABLE),
        stop("e4"),
        stop("r1", RADIO),
        stop("c2", CABLE),
    ):
        outbox.put(item)
    assert taken(outbox) == "e1 c1 r1 e2 c2 e3 e4"


def test_of_a_box_full_of_stops_the_way_that_has_most_gives_up_its_oldest() -> None:
    outbox = Outbox(4)
    for name in ("e1", "e2", "e3"):
        assert outbox.put(stop(name)) is None
    for lone in (stop("c1", CABLE), stop("r1", RADIO)):
        evicted = outbox.put(lone)
    assert evicted is not None
    assert evicted.wire == b"e1"
    evicted = outbox.put(stop("e4"))
    assert evicted is not None
    assert evicted.wire == b"e2"
    evicted = outbox.put(stop("c2", CABLE))
    assert evicted is not None
    assert evicted.wire == b"c1", "counted together with the newcomer, and the first in line of those"
    assert taken(outbox) == "r1 e3 c2 e4"


@pytest.mark.parametrize("capacity", [2, 4])
def test_of_one_way_s_many_stops_those_for_the_robot_that_has_most_go_first(capacity: int) -> None:
    outbox = Outbox(capacity)
    lone = Parcel(b"", None, STOP_LANE, 0.0, 10.0, Fate(frame("pare", "MNERIM"), ARRIVED))
    flood = [Parcel(b"", None, STOP_LANE, 0.0, 10.0, Fate(frame("pare", "LAMP", str(n)), ARRIVED)) for n in range(20)]
    assert not any(outbox.put(each) is lone for each in (lone, *flood))
    last = [f"pare {number}".encode() for number in range(20)][1 - capacity :]
    assert [each.fate.frame.payload for each in outbox] == [b"pare", *last]


def test_where_no_more_stops_fit_an_equal_one_takes_the_place_of_the_older() -> None:
    outbox = Outbox(2)
    outbox.put(stop("a1", key="a"))
    again = stop("a2", key="a")
    assert outbox.swap(again) is None, "there is room for both, and each is answered"
    outbox.put(again)
    older = outbox.swap(stop("a3", CABLE, key="a"))
    assert older is not None
    assert older.wire == b"a1"
    assert outbox.swap(stop("b", key="b")) is None
    assert taken(outbox) == "a3 a2"


@given(
    st.lists(st.sampled_from([ARRIVED, ARRIVED, RADIO, Way("udp", 1), Way("udp", 2), None]), max_size=60),
    st.lists(st.sampled_from([ARRIVED, ARRIVED, RADIO, Way("udp", 1), Way("udp", 2), None]), max_size=60),
    st.integers(5, 9),
)
def test_however_many_stops_other_ways_bring_a_lone_one_leaves_in_its_turn(
    before: list[Way | None], after: list[Way | None], capacity: int
) -> None:
    """None: one stop leaves. There is room for as many as there are ways."""
    outbox, serial = Outbox(capacity), count()
    lone = stop("lone", CABLE)
    evicted: list[Parcel | None] = []
    turns = 0
    for way in before:
        evicted.append(outbox.put(stop(str(next(serial)), way)) if way else outbox.take())
    evicted.append(outbox.put(lone))
    for way in (*after, *[None] * 5):
        if way is not None:
            evicted.append(outbox.put(stop(str(next(serial)), way)))
        else:
            turns += 1
            if outbox.take() is lone:
                break
    assert turns <= 5, "one of each way, its own included"
    assert not any(each is lone for each in evicted)


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
        st.tuples(st.just("equal"), st.integers(1, 3), st.integers(0, 10), st.sampled_from([1, 2])),
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
    """Each parcel comes out once; all but stops in order, by lane and peer; none too late; of set-points the newest."""
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
        if item.lane == COMMAND_LANE:
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
        elif action in ("set", "equal"):
            way = (ARRIVED, CABLE, RADIO)[number - 1]
            set_to(parcel("x", COMMAND_LANE if action == "set" else STOP_LANE, at, peer, (number, peer), way))
        elif action == "stop":
            halt = parcel("stop", STOP_LANE, at, peer)
            out += map(id, outbox.overtaken(halt))
            put(halt)
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
                    if first.lane != STOP_LANE:
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
        assert all(each is newest[each.key] for each in outbox if each.key is not None and each.lane != STOP_LANE)
    out += map(id, outbox.clear())
    assert sorted(out) == sorted(map(id, every))
