"""Learning one episode more, and forgetting one, under what was chosen.

The memory is afterwards the one that all the episodes together make: where the ranges over which
things are coded stay, rows are added at its end or taken out of it; where they grow, all are coded
anew from what the episodes taught.
"""

from dataclasses import replace

from hasm_torch.body import Body
from hasm_torch.config import HASMConfig
from hasm_torch.model.choose import table_codes
from hasm_torch.model.collect import collect
from hasm_torch.model.felt import Recording
from hasm_torch.model.fit import Fitted, build, facts_of, reported, rows, settle
from hasm_torch.model.lessons import Lesson, Lessons
from hasm_torch.model.recalling import Recalling
from hasm_torch.model.settled import Settled
from hasm_torch.model.timed import Timed

# What was chosen is chosen anew when the number of episodes has doubled, so that learning one
# takes a bounded time on average; in between it stays.
CHOOSE_ANEW = 2


def learned(
    config: HASMConfig,
    body: Body,
    settled: Settled,
    recalling: Recalling | Timed,
    lessons: Lessons,
    episode: Recording,
) -> Fitted:
    """Learn one episode more.

    Args:
        config: Settings of the method.
        body: Joints and skin of the robot.
        settled: What was chosen.
        recalling: The memory, which is added to where that is enough.
        lessons: What is known; stays as it is.
        episode: A recording.

    Raises:
        ValueError: If the episode does not fit the body or holds no touch; nothing has changed
            then.
    """
    lesson = collect(config, body, settled, episode, lessons.next)
    if settled.drive == "spike" and not len(lesson.samples):
        raise ValueError(
            "the episode holds no touch that makes a neuron spike, so there is nothing to learn; "
            "check the tactile feature's unit (N) and current_per_newton"
        )
    lessons = lessons.copy()
    lessons.add(lesson)
    if len(lessons) >= CHOOSE_ANEW * settled.chosen_from:
        return settle(config, body, settled, lessons)
    return _changed(config, body, settled, recalling, lessons, added=lesson)


def forgotten(
    config: HASMConfig,
    body: Body,
    settled: Settled,
    recalling: Recalling | Timed,
    lessons: Lessons,
    number: int,
) -> Fitted:
    """Forget the episode of a number, which is not the only one; the rest as above."""
    lessons = lessons.copy()
    del lessons.known[number]
    return _changed(config, body, settled, recalling, lessons, removed=number)


def _changed(
    config: HASMConfig,
    body: Body,
    settled: Settled,
    recalling: Recalling | Timed,
    lessons: Lessons,
    added: Lesson | None = None,
    removed: int | None = None,
) -> Fitted:
    facts = settled if settled.drive == "time" else facts_of(body, settled, lessons)
    # The walk over all states, and what is standardised over all frames, have no rows of one
    # episode alone.
    apart = settled.value != "successor" and isinstance(recalling, Recalling)
    if not apart or facts.code_facts != settled.code_facts:
        facts, recalling = build(config, body, facts, lessons)
    else:
        assert isinstance(recalling, Recalling)
        if added is not None:
            keys, values = rows(config, body, facts, added.samples, added.phases)
            recalling.append(table_codes(config, body, facts, keys), values, keys)
        if removed is not None:
            recalling.remove(removed)
        taught = [body.patches[p] for p in recalling.where[:, 1].unique().tolist()]
        facts = replace(facts, capacity=len(recalling.where), taught=taught)
        recalling.settled = facts
    return Fitted(facts, recalling, lessons, reported(body, facts, recalling, lessons, {}))
