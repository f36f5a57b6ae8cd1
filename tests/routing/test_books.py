"""What became of the frames of each robot: of all that are known, and of a bounded number of others."""

from collections import Counter

from psiu_broker.frame import Address, Way
from psiu_broker.routing.books import Books, Told
from psiu_broker.routing.table import Binding, Route, Table

MNERIM, BETA, ARM = Address.named("MNERIM"), Address.named("BETA"), Address.numbered(0x12)
RADIO = Way("radio")


def told(books: Books, robot: Address | None) -> Told:
    (found,) = (each for each in books.told() if each.robot == robot)
    return found


def kept() -> tuple[Table, Books]:
    """A table that tells its books of each route that is no more."""
    gone: list[Books] = []

    def withdrawn(route: Route) -> None:
        gone[0].departed(route)

    table = Table((), withdrawn)
    gone.append(Books(table.routes))
    return table, gone[0]


def hear(table: Table, robot: Address, times: int = 1) -> None:
    route = table.learn(robot, RADIO, "psiu-ascii", 0.0)
    assert route is not None
    route.frames += times


def test_what_a_route_counts_and_nobody_dropped_was_delivered() -> None:
    table = Table()
    books = Books(table.routes)
    hear(table, MNERIM, 5)
    books.settled(MNERIM, "expired")
    books.settled(MNERIM, "answered")
    assert told(books, MNERIM) == (MNERIM, "radio", 5, 1, {"expired": 1}, 0)
    assert told(books, MNERIM).delivered == 3


def test_what_waits_is_not_delivered_yet() -> None:
    table = Table()
    books = Books(table.routes)
    books.waiting = lambda: {MNERIM: 2, BETA: 1}
    hear(table, MNERIM, 5)
    assert (told(books, MNERIM).waiting, told(books, MNERIM).delivered) == (2, 3)
    assert told(books, None).waiting == 1


def test_a_robot_that_is_gone_and_comes_back_goes_on_where_it_was() -> None:
    table, books = kept()
    hear(table, MNERIM, 5)
    table.forget_link("radio", 1.0)
    assert told(books, MNERIM)[1:3] == (None, 5)
    hear(table, MNERIM, 2)
    books.arrived(MNERIM)
    assert told(books, MNERIM)[1:3] == ("radio", 8)


def test_a_name_and_a_number_are_one_robot_as_soon_as_that_is_known() -> None:
    table, books = kept()
    hear(table, ARM, 3)
    books.settled(ARM, "no_route")
    table.place((BETA, ARM), Way("@mesh", "hill"), "psiu-hexa", 1.0)
    table.routes[BETA].frames += 2
    books.settled(ARM, "expired")
    assert told(books, BETA) == (BETA, "@mesh", 5, 0, {"no_route": 1, "expired": 1}, 0)
    assert [each.robot for each in books.told()] == [BETA, None]


def test_a_robot_of_the_configuration_is_one_by_either_of_its_addresses() -> None:
    table = Table((Binding(BETA, ARM, Way("arm"), "psiu-hexa"),))
    books = Books(table.routes)
    for source in (BETA, ARM):
        books.arrived(source)
        books.settled(source, "refused")
    assert told(books, BETA) == (BETA, "arm", 2, 0, {"refused": 2}, 0)


def test_however_many_names_there_are_the_books_stay_small_and_lose_no_frame() -> None:
    table = Table()
    books = Books(table.routes, capacity=64)
    hear(table, MNERIM, 7)
    books.settled(MNERIM, "expired")
    waits = Address.named("N3")
    books.waiting = lambda: Counter({waits: 1})
    for number in range(5000):
        name = Address.named(f"N{number}")
        books.arrived(name)
        if name != waits:
            books.settled(name, "no_route")
    accounts = list(books.told())
    assert len(accounts) <= 64 + 3
    assert sum(each.arrived for each in accounts) == 5007
    assert told(books, MNERIM).dropped == {"expired": 1}
    assert told(books, None).dropped["no_route"] > 4900
    assert told(books, waits)[2:] == (1, 0, {}, 1), "else its fate would be written down where it did not arrive"
    assert told(books, Address.named("N4999")).arrived == 1, "the latest are kept"


def test_what_names_nobody_is_counted_as_well() -> None:
    books = Books({})
    books.nameless("malformed")
    assert list(books.told()) == [(None, None, 1, 0, {"malformed": 1}, 0)]


def test_nothing_is_missed_in_the_moment_when_two_robots_turn_out_to_have_shared_a_number() -> None:
    table, books = kept()
    table.place((MNERIM, ARM), Way("@mesh", "hill"), "psiu-hexa", 0.0)
    table.routes[MNERIM].frames += 1
    table.withdraw(table.routes[MNERIM], 1.0)
    hear(table, MNERIM, 5)
    books.arrived(BETA)
    table.place((BETA, ARM), Way("@mesh", "hill"), "psiu-hexa", 2.0)
    assert sum(each.arrived for each in books.told()) == 1 + 5 + 1
