import asyncio

from psiu_broker.bus.replies import Replies
from psiu_broker.bus.session import Session
from psiu_broker.bus.work import Work


async def test_work_under_way_is_cancelled_and_waited_for_even_before_its_first_step(session: Session) -> None:
    work = Work(Replies(session, "test"))
    said: list[str] = []

    async def say(word: str) -> None:
        try:
            await asyncio.Event().wait()
        except asyncio.CancelledError:
            await asyncio.sleep(0)
            said.append(word)

    work.begin(say("earlier"))
    await asyncio.sleep(0)
    work.begin(say("not begun"))
    assert not work.closed
    await work.close()
    assert work.closed
    assert sorted(said) == ["earlier", "not begun"]


async def test_work_that_is_done_is_not_waited_for(session: Session) -> None:
    work = Work(Replies(session, "test"))
    work.begin(asyncio.sleep(0))
    await asyncio.sleep(0.01)
    async with asyncio.timeout(1):
        await work.close()
