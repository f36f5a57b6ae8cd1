import pytest

from psiu_broker.simulator import Faults

PIECE = bytes(range(32))
PIECES = 4000


def arrived(faults: Faults, name: str = "in") -> list[tuple[float, bytes]]:
    line = faults.line(name, 0.0)
    return [(n * 10 + delay_s, piece) for n in range(PIECES) for delay_s, piece in line.carry(PIECE, n * 10.0)]


def test_a_line_without_faults_changes_nothing() -> None:
    assert arrived(Faults()) == [(n * 10.0, PIECE) for n in range(PIECES)]


@pytest.mark.parametrize("chance", [0.05, 0.3, 1.0])
def test_loss_takes_the_chance_it_is_given(chance: float) -> None:
    assert len(arrived(Faults(loss=chance))) / PIECES == pytest.approx(1 - chance, abs=0.03)


@pytest.mark.parametrize("chance", [0.05, 0.3, 1.0])
def test_corruption_flips_one_bit_of_the_chance_it_is_given(chance: float) -> None:
    pieces = [piece for _, piece in arrived(Faults(corruption=chance))]
    damage = [(int.from_bytes(piece) ^ int.from_bytes(PIECE)).bit_count() for piece in pieces]
    assert set(damage) <= {0, 1}
    assert sum(damage) / PIECES == pytest.approx(chance, abs=0.03)
    places = {int.from_bytes(piece) ^ int.from_bytes(PIECE) for piece in pieces}
    assert len(places) > 100


def test_duplicates_come_twice_in_a_row() -> None:
    times = [at for at, _ in arrived(Faults(duplicate=0.25))]
    assert len(times) / PIECES == pytest.approx(1.25, abs=0.03)


def test_delay_and_jitter_stay_within_their_bounds() -> None:
    delays = [at % 10 for at, _ in arrived(Faults(delay_s=1.0, jitter_s=0.5))]
    assert min(delays) == pytest.approx(1.0, abs=0.01)
    assert max(delays) == pytest.approx(1.5, abs=0.01)


def test_jitter_never_lets_a_piece_overtake() -> None:
    line = Faults(jitter_s=1.0).line("in", 0.0)
    times = [now + delay_s for now in (n * 0.01 for n in range(1000)) for delay_s, _ in line.carry(PIECE, now)]
    assert times == sorted(times)


def test_nothing_passes_during_a_silence_which_begins_with_the_line() -> None:
    line = Faults(silences=[(1.0, 2.0), (5.0, 6.0)]).line("in", 100.0)
    passed = [now for now in (100.0, 100.9, 101.0, 101.9, 102.0, 105.5, 106.0) if line.carry(PIECE, now)]
    assert passed == [100.0, 100.9, 102.0, 106.0]


def test_one_byte_at_a_time_spaces_the_bytes_and_keeps_their_order() -> None:
    line = Faults(one_byte_at_a_time=True).line("in", 0.0)
    arrivals = line.carry(b"abc", 0.0) + line.carry(b"de", 0.0)
    assert b"".join(piece for _, piece in arrivals) == b"abcde"
    assert [at for at, _ in arrivals] == pytest.approx([0, 0.001, 0.002, 0.003, 0.004])


def test_the_same_seed_has_the_same_faults_and_another_seed_or_direction_others() -> None:
    faults = Faults(loss=0.2, corruption=0.2, duplicate=0.2, jitter_s=0.1, seed=7)
    assert arrived(faults) == arrived(faults)
    assert arrived(faults) != arrived(faults, "out")
    assert arrived(faults) != arrived(Faults(loss=0.2, corruption=0.2, duplicate=0.2, jitter_s=0.1, seed=8))


def test_adding_one_fault_leaves_the_luck_of_the_others_alone() -> None:
    lost = {at for at, _ in arrived(Faults(loss=0.2))}
    assert {at for at, _ in arrived(Faults(loss=0.2, corruption=0.5))} == lost


@pytest.mark.parametrize("wrong", [{"loss": 1.5}, {"corruption": -0.1}, {"delay_s": -1.0}, {"silences": [(2.0, 1.0)]}])
def test_impossible_faults_are_refused(wrong: dict[str, object]) -> None:
    with pytest.raises(ValueError, match=r"chance|negative"):
        Faults(**wrong)  # type: ignore[arg-type]
