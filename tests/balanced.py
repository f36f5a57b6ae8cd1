"""What holds of a broker's books at every moment."""

from collections import Counter

from psiu_broker.exchange import Exchange
from psiu_broker.routing.verdicts import KEPT, Verdict


def assert_balanced(exchange: Exchange) -> None:
    """Of each link and of each robot, arrived = settled + waiting; and both, counted apart, tell of the same frames."""
    waiting = exchange.waiting()
    totals: Counter[Verdict] = Counter()
    for name, account in exchange.accounts.items():
        assert account.arrived == account.settled() + waiting[name], name
        totals.update(account.fates)
    robots = list(exchange.router.books.told())
    assert all(robot.delivered >= 0 for robot in robots), [robot for robot in robots if robot.delivered < 0]
    assert sum(robot.arrived for robot in robots) == sum(account.arrived for account in exchange.accounts.values())
    assert sum(robot.waiting for robot in robots) == sum(waiting.values())
    assert sum(robot.answered for robot in robots) == totals["answered"]
    assert sum(robot.delivered for robot in robots) == totals["delivered"]
    dropped: Counter[Verdict] = Counter()
    for robot in robots:
        dropped.update(robot.dropped)
    assert +dropped == Counter({verdict: count for verdict, count in totals.items() if count and verdict not in KEPT})
