"""Every frame ends in one of a closed set of verdicts, and a drop is any that is not kept."""

from typing import Any, get_args

import pytest

from psiu_broker.routing import verdicts
from psiu_broker.routing.verdicts import KEPT, Account, Verdict

EVERY = get_args(Verdict)


def test_each_verdict_has_its_name_once() -> None:
    named = [value for name, value in vars(verdicts).items() if name.isupper() and isinstance(value, str)]
    assert sorted(named) == sorted(EVERY)


def test_the_books_take_no_other_verdict() -> None:
    account = Account()
    other: Any = "forgotten"
    with pytest.raises(KeyError):
        account.fates[other] += 1


def test_what_is_neither_delivered_nor_answered_was_dropped() -> None:
    account = Account()
    for verdict in EVERY:
        account.fates[verdict] += 1
    assert account.dropped() == dict.fromkeys(set(EVERY) - KEPT, 1)
    assert account.settled() == len(EVERY)
