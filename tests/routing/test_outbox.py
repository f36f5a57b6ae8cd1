from hypothesis import given
from hypothesis import strategies as st

from psiu_broker.frame import Address, Frame, Way
from psiu_broker.routing.outbox import COMMAND_LANE, QUESTION_LANE, STOP_LANE, Fate, Outbox, Parcel, lane

ARRIVED = Way("wifi")


def frame(subject: str = "parafrente") -> Frame:
    return Frame(Address.named("PC"), Address.named("MNERIM"), subject, subject.encode(), "psiu-ascii")


def parcel(name: str, lane: int = COMMAND_LANE, expires: float = 10.0, peer: object = None) -> Parcel:
    return Parcel(name.encode(), peer, lane, 0.0, expires, Fate(frame(), ARRIVED))


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
    assert lane(frame("qualseunome")) == QUESTION_LANE


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
        st.tuples(st.just("put"), st.integers(0, 2), st.floats(0, 10)),
        st.tuples(st.just("take"), st.just(0), st.just(0.0)),
        st.tuples(st.just("expire"), st.just(0), st.floats(0, 10)),
        st.tuples(st.just("remove_peer"), st.integers(0, 2), st.just(0.0)),
    )
)


@given(steps, st.integers(1, 5))
def test_every_parcel_comes_out_exactly_once(steps: list[tuple[str, int, float]], capacity: int) -> None:
    outbox = Outbox(capacity)
    put: list[int] = []
    out: list[int] = []
    kept = []
    for action, lane_or_peer, at in steps:
        if action == "put":
            item = parcel("x", lane_or_peer, at, peer=lane_or_peer)
            kept.append(item)
            put.append(id(item))
            evicted = outbox.put(item)
            out += [] if evicted is None else [id(evicted)]
        elif action == "take":
            item_or_none = outbox.take()
            out += [] if item_or_none is None else [id(item_or_none)]
        elif action == "expire":
            out += map(id, outbox.expire(at))
        else:
            out += map(id, outbox.remove_peer(lane_or_peer))
        assert outbox.size == len(list(outbox)) <= capacity
    out += map(id, outbox.clear())
    assert sorted(out) == sorted(put)
