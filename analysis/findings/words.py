"""Findings in words: one function, with one case a kind."""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from dataclasses import replace
from typing import NamedTuple, TypeAlias

from stickslip.analysis.findings.finding import (
    Alike,
    Attracting,
    Basis,
    Bound,
    Change,
    Comparison,
    Course,
    Decided,
    Difference,
    Finding,
    Fit,
    Form,
    KeyChange,
    Lack,
    Law,
    Level,
    Lifetime,
    Outcomes,
    Parts,
    Quantity,
    Regime,
    Scale,
    Share,
    Statement,
    Threshold,
    Turn,
    Verdict,
    in_unit,
)
from stickslip.analysis.findings.numbers import bare, decimals, is_exact, number, signs, span, with_interval
from stickslip.analysis.findings.place import EVERYWHERE, Place
from stickslip.analysis.stats.estimates import Estimate

MOST_WORDS = 25  # of a first sentence; signs count, and a number with its power of ten as one

#: What a finding says: each can be a sentence of its own, and the first is the answer.
Clauses: TypeAlias = tuple[str, ...]


class Addition(NamedTuple):
    """What is added to a clause: a phrase in it, or a clause of its own."""

    phrase: str = ""
    clause: str = ""

    def to(self, text: str, mark: str = ",") -> Clauses:
        """A clause with the addition, after a mark if that is a phrase."""
        return (text, self.clause) if self.clause else (f"{text}{mark} {self.phrase}" if self.phrase else text,)


def sentence(finding: Finding) -> str:
    """A finding as a sentence of at most `MOST_WORDS` words, and what does not fit as others."""
    truth, said = (f"{finding.truth.value}: ", finding.finding) if isinstance(finding, Decided) else ("", finding)
    forms = [*_forms(said)]
    clauses, notes = next((form for form in forms if _fits(truth + form[0][0])), forms[-1])
    first, *others = truth + clauses[0], *clauses[1:]
    while others and _fits(f"{first}; {others[0]}"):
        first = f"{first}; {others.pop(0)}"
    return " ".join(f"{capital(signs(text))}." for text in (first, *others, *notes))


def _fits(text: str) -> bool:
    return text.replace(" \u00d7 ", "").count(" ") < MOST_WORDS


def _forms(finding: Statement) -> Iterator[tuple[Clauses, Clauses]]:
    """A finding, ever shorter, as clauses and notes, which are sentences of their own."""
    yield _clauses(finding), ()
    if isinstance(finding, Outcomes):
        yield from _in_numbers(finding)
        return
    where, bare_finding = place_of(finding), _anywhere(finding)
    setting = (f"setting: {where}",) * bool(where)
    yield _clauses(bare_finding), setting
    yield _clauses(bare_finding, is_brief=True), setting


def _in_numbers(outcomes: Outcomes) -> Iterator[tuple[Clauses, Clauses]]:
    """Settings by outcome, with how many these are, and which as notes."""
    compared = (f"compared: {outcomes.scope}",) * bool(outcomes.scope)
    outcomes = replace(outcomes, scope="")
    yield _outcomes(outcomes), compared
    groups = (outcomes.different, outcomes.equal, outcomes.undecided, outcomes.others)
    different, equal, undecided, others = map(_counted, groups)
    counted = replace(outcomes, different=different, equal=equal, undecided=undecided, others=others)
    notes = (*compared, *(f"settings: {', '.join(group)}" for group in groups if len(group) > 1))
    yield _outcomes(counted), notes
    if outcomes.largest is not None:
        yield _outcomes(counted, is_brief=True), (*notes, "; ".join(_level(outcomes.largest)))


def place_of(finding: Finding) -> Place:
    """Where a finding holds."""
    match finding:
        case Law():
            return finding.parameter.where
        case Parts():
            return finding.whole.where
        case Decided():
            return place_of(finding.finding)
        case Lack():
            return EVERYWHERE
    return finding.where


def _anywhere(finding: Statement) -> Statement:
    """A finding without where it holds."""
    match finding:
        case Law():
            return replace(finding, parameter=replace(finding.parameter, where=EVERYWHERE))
        case Parts():
            return replace(finding, whole=replace(finding.whole, where=EVERYWHERE))
        case Lack():
            return finding
    return replace(finding, where=EVERYWHERE)


def _clauses(finding: Statement, is_brief: bool = False) -> Clauses:
    """A finding without capitals and full stops; in brief, the first clause is as short as can be."""
    match finding:
        case Level():
            return _level(finding, is_brief)
        case Change():
            return _change(finding, is_brief)
        case Share():
            return _share(finding, is_brief)
        case Lifetime():
            return _lifetime(finding, is_brief)
        case Law():
            return _law(finding, is_brief)
        case Parts():
            return _parts(finding)
        case Alike(quantity, value, among, where):
            is_count = quantity.form is Form.COUNT
            digits = decimals(Estimate(value), quantity.form) + (not is_count)  # it is known to many
            shown = in_unit(number(value, quantity.form, digits), quantity.unit)
            return (f"{quantity.name}{where.tail}: {shown}, the same {among}",)
        case Outcomes():
            return _outcomes(finding)
        case Threshold(subject, is_end, key, last, first, where, basis):
            in_all = "" if basis is None or basis.n == 1 else f", in all {based_on(basis)}"
            ends = f"{'ends' if is_end else 'begins'} between {key} = {last} and {in_unit(first, finding.unit)}"
            return (f"{subject} {ends}{where.tail}{in_all}",)
        case Regime():
            return _regime(finding)
        case Attracting():
            return _attracting(finding)
        case Lack(what, reason, detail):
            return (f"{what}: {reason.value}{f' ({detail})' * bool(detail)}",)


def capital(text: str) -> str:
    """A text with a capital first letter, unless it begins with a symbol: a letter by itself, or a Greek one."""
    is_symbol = text[:1] > "\x7f" or (text[:1] not in ("a", "A") and not text[1:2].isalpha())
    return text if is_symbol else text[:1].upper() + text[1:]


def listed(names: Sequence[str], last: str = "and") -> str:
    """Names in a sentence: "a, b and c"."""
    return names[0] if len(names) == 1 else f"{', '.join(names[:-1])} {last} {names[-1]}"


def by_ends(names: Sequence[str]) -> list[str]:
    """Names of neighbours, three or more by the first and the last: "4 to 7"."""
    return [*names] if len(names) < 3 else [f"{names[0]} to {names[-1]}"]


def plural(n: int, noun: str) -> str:
    """A number of things: "1 run", "20 systems"."""
    return f"{n:,} {noun}{'s' * (n != 1)}"


def based_on(basis: Basis | None) -> str:
    """What a finding rests on, for a table: "20 systems"."""
    return "" if basis is None else plural(basis.n, basis.unit)


def _share(share: Share, is_brief: bool) -> Clauses:
    estimate, comparison, basis = share.estimate, share.comparison, share.basis
    is_whole, is_bare = estimate.value in (0.0, 1.0), basis is not None and estimate == Estimate(estimate.value)
    bracket = f" ({based_on(basis)}, no interval)" * is_bare
    head, tail = (share.where.head, "") if share.where.has_key else ("", share.where.tail)
    amount = _amount(estimate, share.n if is_whole else None, share.things, basis)
    words = f"{head}{amount} {share.predicate}{tail}{bracket}"
    difference = None if comparison is None else comparison.difference
    if bracket or comparison is None or difference is None or difference.verdict is not Verdict.OPEN:
        return _beside(words, comparison, None, is_brief)
    return f"{words}, consistent with {comparison.other}", f"the difference is {_signed(difference, Form.SHARE)}"


def _amount(share: Estimate, n: int | None, things: str, basis: Basis | None = None, place: str = "") -> str:
    """How many of n things: "80% (38 to 96%) of 5 runs", "all 40 runs of 20 systems (at least 84%)"."""
    count = f"{n:,} {things}" if n is not None and n > 1 else things
    if n is not None and basis is not None and 1 < basis.n < n and things != f"{basis.unit}s":
        count += f" of {based_on(basis)}"
    if share.value not in (0.0, 1.0):
        return f"{with_interval(share, Form.SHARE)} of {count}"
    bound, end = ("lower bound", share.low) if share.value else ("upper bound", share.high)
    digits = decimals(share, Form.SHARE)
    bracket = "" if end in (None, share.value) else f" ({bound} {number(end, Form.SHARE, digits)}{place})"
    return ("all " if share.value else f"none of {'the ' * (count == things)}") + count + bracket


def _level(level: Level, is_brief: bool = False) -> Clauses:
    quantity = level.quantity
    words = _value(quantity, level.estimate)
    if level.basis is not None and level.basis.n > 1 and is_exact(level.estimate):
        words = f"{words} in all {based_on(level.basis)}"
    if not quantity.clause:
        name = quantity.name + (f", {level.where}" if level.where else "")
        return _beside(f"{name}: {words}", level.comparison, quantity, is_brief)
    compared = "" if is_brief else _in_clause(level)
    said = level.where.head + quantity.clause.format(compared or words)
    return (said,) if compared else _beside(said, level.comparison, quantity, is_brief)


def _value(quantity: Quantity, estimate: Estimate) -> str:
    """An estimate with its unit."""
    return in_unit(with_interval(estimate, quantity.form), quantity.unit)


def _alone(quantity: Quantity, estimate: Estimate) -> str:
    """An estimate to the digits that its interval leaves, without that, and without its unit."""
    assert estimate.value is not None
    return number(estimate.value, quantity.form, decimals(estimate, quantity.form))


def _in_clause(level: Level) -> str:
    """What stands in the clause of a quantity instead of its value, if a comparison tells."""
    if level.comparison is None or (difference := level.difference) is None:
        return ""
    reference, form = level.comparison.other, level.quantity.form
    if difference.side is Verdict.EQUAL:
        return f"{_within(difference, form)} of that for {reference}"
    if difference.side not in (Verdict.MORE, Verdict.LESS):
        return ""
    if (times := ratio(difference)) is not None:
        return f"{times} times as much as for {reference}"
    side = "more" if difference.side is Verdict.MORE else "less"
    return f"{size(difference, form)} {side} than for {reference}{_in_margin(difference, form)}"


def _beside(text: str, comparison: Comparison | None, quantity: Quantity | None, is_brief: bool) -> Clauses:
    """A clause about an estimate, and what a comparison adds; in brief always as a clause of its own."""
    addition = Addition() if comparison is None else _compared(comparison, quantity)
    return (text, f"it is {addition.phrase}") if is_brief and addition.phrase else addition.to(text)


def _compared(comparison: Comparison, quantity: Quantity | None) -> Addition:
    reference, difference = comparison.other, comparison.difference
    if comparison.value is not None and quantity is not None:
        reference = f"{reference} at {_value(quantity, comparison.value)}"
    if difference is None:
        return Addition(f"compared with {reference}")
    above, less = ("above", "below") if quantity is None else (quantity.more, quantity.less)
    form = Form.SHARE if quantity is None else quantity.form
    match difference.side:
        case Verdict.MORE if (times := ratio(difference)) is not None:
            return Addition(f"{times} times that of {reference}")
        case Verdict.MORE | Verdict.LESS as verdict:
            side, within = above if verdict is Verdict.MORE else less, _in_margin(difference, form)
            return Addition(f"{size(difference, form)}{_of(difference, quantity)} {side} {reference}{within}")
        case Verdict.EQUAL:
            return Addition(f"{_within(difference, form)} of {reference}")
        case Verdict.SAME:
            return Addition(f"the same as {reference} in every run")
        case Verdict.OPEN:
            return Addition(clause=f"no difference from {reference} is shown ({interval(difference, form)})")
        case Verdict.OPEN_AMONG_MANY:
            distance = f"{reference}: {interval(difference, form)}"
            return Addition(clause=f"difference from {distance}, not significant among {_n_tests(difference)}")
        case Verdict.UNJUDGED if difference.estimate.value is not None:
            distance = _signed(difference, form) + _of(difference, quantity)
            return Addition(clause=f"the difference from {reference} is {distance}, without an interval")
        case Verdict.UNJUDGED:
            return Addition(f"compared with {reference}, without an interval")


def _of(difference: Difference, quantity: Quantity | None) -> str:
    """The unit of a difference, if that is not relative, after its size."""
    return "" if quantity is None or difference.scale is Scale.RELATIVE else in_unit("", quantity.unit)


def ratio(difference: Difference) -> str | None:
    """A relative difference of more than 100% as a ratio, "11.4 (5.8 to 22.3)"; None of any other."""
    value = difference.estimate.value
    if difference.scale is not Scale.RELATIVE or value is None or value < 1.0:
        return None
    return with_interval(difference.estimate.under(lambda relative: 1.0 + relative))


def difference_in_words(difference: Difference, form: Form = Form.NUMBER) -> tuple[str, str]:
    """A difference as the cell of a table, and what it comes to: "+0.9% (+0.6 to +1.3%)", "within 5%"."""
    verdict, estimate = difference.verdict, difference.estimate
    if verdict is Verdict.SAME:
        return "none in any run", ""
    if estimate.value is None:
        return "unknown" if verdict is Verdict.UNJUDGED else interval(difference, form), ""
    text = _signed(difference, form)
    if verdict is Verdict.EQUAL:
        return text, f"within {margin(difference, form)}"
    return text, "not significant after Holm's correction" * (verdict is Verdict.OPEN_AMONG_MANY)


def size(difference: Difference, form: Form = Form.NUMBER) -> str:
    """How large a difference is, without its sign, with its interval: "0.9% (0.6 to 1.3%)"."""
    unit = form_of(difference, form)
    return with_interval(_without_sign(difference.estimate), unit) + _AFTER[unit]


def _without_sign(estimate: Estimate) -> Estimate:
    value, low, high = estimate.value, estimate.low, estimate.high
    if value is None or value >= 0.0:
        return estimate
    return Estimate(-value, None if high is None else -high, None if low is None else -low)


def interval(difference: Difference, form: Form = Form.NUMBER) -> str:
    """The interval of a difference, with signs."""
    low, high = difference.estimate.low, difference.estimate.high
    assert low is not None
    assert high is not None
    unit = form_of(difference, form)
    return span(low, high, unit, sign=True) + _AFTER[unit]


def _within(difference: Difference, form: Form) -> str:
    """That a difference is less than its margin, with its interval."""
    unit = form_of(difference, form)
    return f"within {margin(difference, form)} ({interval(difference, form).removesuffix(_AFTER[unit])})"


def _in_margin(difference: Difference, form: Form) -> str:
    """What follows a difference to one side that is within its margin."""
    return f", within the margin of {margin(difference, form)}" if difference.verdict is Verdict.EQUAL else ""


def margin(difference: Difference, form: Form = Form.NUMBER) -> str:
    """The margin of a difference."""
    assert difference.margin is not None
    match form_of(difference, form):
        case Form.SHARE:
            return f"{100 * difference.margin:g}%"
        case Form.POINTS:
            return f"{100 * difference.margin:g}{_AFTER[Form.POINTS]}"
    return f"{difference.margin:g}"


#: What follows a number and its interval.
_AFTER = dict.fromkeys(Form, "") | {Form.POINTS: " percentage points"}


def form_of(difference: Difference, form: Form) -> Form:
    """How a difference of a quantity is written: relative to another in per cent, of shares in percentage points."""
    if difference.scale is Scale.RELATIVE:
        return Form.SHARE
    return Form.POINTS if form is Form.SHARE else form


def _n_tests(difference: Difference) -> str:
    assert difference.family is not None
    return f"{difference.family.n} comparisons"


def _change(change: Change, is_brief: bool = False) -> Clauses:
    if is_brief and (others := change.keys[1:]):
        along_with = listed([_goes(other) for other in others])
        return *_change(replace(change, keys=change.keys[:1]), is_brief), f"with it {along_with}"
    name, difference = change.quantity.name, change.difference
    head, *tails = change.keys
    goes = listed([_goes(head), *(_goes(key, "") for key in tails)])
    along = f"as {goes}{change.where.tail}"
    if change.turns:
        return _turning(change, along)
    match difference.side:
        case Verdict.MORE | Verdict.LESS as verdict:
            verb = "rises" if verdict is Verdict.MORE else "falls"
            within = _in_margin(difference, change.quantity.form)
            if is_brief:
                return f"{name} {verb} {_by(change)} {along}", f"it {verb} {_from_to(change)}{within}"
            return (f"{name} {verb} {_from_to(change)}, {_by(change)}{within}, {along}",)
        case Verdict.EQUAL:
            return (f"{name} stays {_within(difference, change.quantity.form)} {along}",)
        case Verdict.SAME:
            return (f"{name} is the same in every run {along}",)
        case Verdict.OPEN | Verdict.OPEN_AMONG_MANY:
            words = _open(change)
            return (
                (f"no change of the {name} is shown {along}", f"it {words}")
                if is_brief
                else (f"{name} {words} {along}",)
            )
        case Verdict.UNJUDGED:
            basis = () if change.basis is None else (f"{based_on(change.basis)}, no interval",)
            return f"{name} goes {_from_to(change)} {along}", *basis


MOST_TURNS = 2  # whose places a sentence says


def _turning(change: Change, along: str) -> Clauses:
    """A change that is not one way all along."""
    quantity, name, turns = change.quantity, change.quantity.name, change.turns
    start, end = _alone(quantity, change.before), in_unit(_alone(quantity, change.after), quantity.unit)
    if len(turns) > MOST_TURNS:
        return f"{name} turns {len(turns)} times {along}", f"it goes {_from_to(change)}"
    if len(turns) > 1:
        through = listed([_value(quantity, turn.estimate) for turn in turns])
        return f"{name} has {extrema(turns)}", f"it goes from {start} through {through} to {end} {along}"
    there = f"{_value(quantity, turns[0].estimate)} near {turns[0].near}"
    match turns[0].course:
        case Course.MINIMUM:
            return f"{name} has a minimum of {there}", f"it falls from {start} and rises to {end} {along}"
        case Course.MAXIMUM:
            return f"{name} has a maximum of {there}", f"it rises from {start} and falls to {end} {along}"


def extrema(turns: Sequence[Turn]) -> str:
    """Where a quantity has minima and maxima along a key, which is named once."""
    first, *further = turns
    values = [str(first.near), *(value for turn in further for _, value in turn.near.parts)]
    return listed([f"a {turn.course} near {value}" for turn, value in zip(turns, values, strict=True)])


def _goes(key: KeyChange, verb: str = " goes") -> str:
    """What goes from where to where."""
    said = key.said
    return f"{said.key}{verb} from {said.first} to {in_unit(said.second, said.unit)}"


def _open(change: Change) -> str:
    """Levels and the estimate of a change that is not shown."""
    form, difference = change.quantity.form, change.difference
    start, end = _levels(change)
    is_level = end == in_unit(start, change.quantity.unit)
    levels = f"is {end} at both ends" if is_level else f"goes from {start} to {end}"
    value = difference.estimate.value
    assert value is not None
    unit = form_of(difference, form)
    text = bare(value, unit, decimals(difference.estimate, unit), sign=True)
    is_of_many = difference.verdict is Verdict.OPEN_AMONG_MANY
    family = f", not significant among {_n_tests(difference)}" if is_of_many else ""
    return f"{levels} (change {text}, {interval(difference, form)}{family})"


def _by(change: Change) -> str:
    """By how much a quantity changes; what is the same in each unit has no interval."""
    estimate, basis = change.difference.estimate, change.basis
    if basis is not None and is_exact(estimate):
        return f"by the same in all {plural(basis.n, basis.unit)}"
    return f"by {size(change.difference, change.quantity.form)}{_of(change.difference, change.quantity)}"


def _from_to(change: Change) -> str:
    return "from {} to {}".format(*_levels(change))


def _levels(change: Change) -> tuple[str, str]:
    """The quantity before, and after with its unit."""
    start, end = change.before.value, change.after.value
    assert start is not None
    assert end is not None
    form, places = change.quantity.form, _digits(change, start, end)
    return number(start, form, places), in_unit(number(end, form, places), change.quantity.unit)


def _digits(change: Change, start: float, end: float) -> int:
    """The decimals with which two values have the difference that is printed beside them."""
    form, estimate = change.quantity.form, change.difference.estimate
    unit, is_absolute = form_of(change.difference, form), change.difference.scale is Scale.ABSOLUTE
    least = decimals(estimate if is_absolute else Estimate(max(abs(start), abs(end))), form)
    last_digit = 10.0 ** -(decimals(estimate, unit) + 2 * (unit in (Form.SHARE, Form.POINTS)))
    for places in (least, least + 1, least + 2):
        before, after = (round(level, places + 2 * (form is Form.SHARE)) for level in (start, end))
        difference = (after - before) / (1.0 if is_absolute else abs(before) or 1.0)
        if abs(difference - (estimate.value or 0.0)) <= 0.5 * last_digit:
            return places
    return least


def _lifetime(lifetime: Lifetime, is_brief: bool) -> Clauses:
    name, value = lifetime.quantity.name + lifetime.where.tail, _value(lifetime.quantity, lifetime.estimate)
    return _beside(f"{name}: {value}", lifetime.comparison, lifetime.quantity, is_brief)


def _law(law: Law, is_brief: bool) -> Clauses:
    level, predicate = law.parameter, law.predicate
    subject = level.where.head + law.subject
    if law.fit is Fit.FAILS:
        far = [] if law.departure is None else _level(replace(law.departure, where=EVERYWHERE))
        return (f"{subject} do not {predicate}" + f" ({'; '.join(far)})" * bool(far),)
    if law.fit is Fit.OPEN:
        return f"whether {law.subject}{level.where.tail} {predicate} is open", *_level(level, is_brief)
    if law.fit is Fit.CLOSE:
        predicate = law.nearly or f"nearly {predicate}"
    share = None if law.scope is None else law.scope.estimate.value
    scope = "" if share is None else f"{number(share, Form.SHARE, int(share < 0.995))} of {law.things}"
    bracket, apart = ("", (f"the law is of {scope}",)) if scope and is_brief else (f" ({scope})" * bool(scope), ())
    parameter = f"{law.called or level.quantity.name} {with_interval(level.estimate, level.quantity.form)}"
    said = f"{subject} {predicate}{bracket}: {parameter}"
    return *_beside(said, level.comparison, level.quantity, is_brief), *apart


def _parts(sum_of: Parts) -> Clauses:
    """What the last part does, and what the others add."""
    total, *smaller, largest = sum_of.whole, *sum_of.parts
    form = total.quantity.form
    head, name, subject = total.where.head, largest.quantity.name, sum_of.subject or total.quantity.name
    value, low, high = largest.estimate.value, largest.estimate.low, largest.estimate.high
    assert value is not None
    if low is not None and high is not None and low <= 0.0 <= high:
        words = f"{head}no effect of {name} on the {subject} is shown ({span(low, high, form, sign=True)})"
    else:
        amount = with_interval(_without_sign(largest.estimate), form)
        words = f"{head}{name} {'raises' if value > 0.0 else 'lowers'} the {subject} by {amount}"
    adds = [f"{level.quantity.name} adds {with_interval(level.estimate, form, sign=True)}" for level in smaller]
    return words, ", ".join(adds)


def _outcomes(outcomes: Outcomes, is_brief: bool = False) -> Clauses:
    """Settings by outcome; if there is a largest difference that is shown, it is what the sentence says first."""
    reference, largest = outcomes.other, outcomes.largest
    scope = f" in {outcomes.scope}" if outcomes.scope else ""
    words = []
    distance = "" if is_brief or largest is None else _larger(largest, reference)
    if outcomes.different and distance and largest is not None:
        words.append(f"{outcomes.at_largest} gives {distance}")
        if outcomes.others:
            by = "" if outcomes.second is None else f", by {_signed(outcomes.second, largest.quantity.form)}"
            words.append(f"{listed(outcomes.others)} also differ{_s(outcomes.others)}{scope}{by}")
    elif outcomes.different:
        words.append(f"{listed(outcomes.different)} differ{_s(outcomes.different)} from {reference}")
    if outcomes.equal:
        words.append(f"{listed(outcomes.equal)} agree{_s(outcomes.equal)} with {reference}{scope}")
    if outcomes.undecided:
        beside = "" if outcomes.equal else f" from {reference}{scope}"
        n = "" if largest is None or largest.basis is None else f" ({based_on(largest.basis)})"
        words.append(f"no difference{beside} is shown for {listed(outcomes.undecided, 'or')}{n}")
    words[0] = outcomes.where.head + words[0]
    if outcomes.equal and outcomes.undecided:
        return (*words,)
    if is_brief or largest is None or (outcomes.different and largest.difference is not None):
        return (*words,)
    is_elsewhere = outcomes.undecided and outcomes.at_largest not in ("", *outcomes.undecided)
    addition = _most_apart(largest, f", for {outcomes.at_largest}" if is_elsewhere else "")
    return *words[:-1], *addition.to(words[-1], ":")


def _s(settings: Sequence[str]) -> str:
    """The ending of the verb of some settings."""
    return "s" if len(settings) == 1 and not settings[0].endswith("settings") else ""


def _counted(settings: tuple[str, ...]) -> tuple[str, ...]:
    """Settings as their number, if they are several."""
    return settings if len(settings) < 2 else (f"{len(settings)} settings",)


def _larger(level: Level, other: str) -> str:
    """A difference that is shown as an object: "31% (20 to 41%) fewer slip onsets than exact"; else empty."""
    difference, name, things = level.difference, level.quantity.name, level.quantity.things
    if difference is None or difference.verdict not in (Verdict.MORE, Verdict.LESS):
        return ""
    is_more = difference.verdict is Verdict.MORE
    if (times := ratio(difference)) is not None:
        many = f"as many {things} as {other}" if things else f"the {name} of {other}"
        return f"{times} times {many}{_against(level)}"
    amount, values = size(difference, level.quantity.form), _against(level)
    if things and difference.scale is Scale.RELATIVE:
        return f"{amount} {'more' if is_more else 'fewer'} {things} than {other}{values}"
    return f"a {name} {amount} {'higher' if is_more else 'lower'} than {other}{values}"


def _against(level: Level) -> str:
    """Both values of a comparison, after its difference, where that of the reference is not said elsewhere."""
    if level.comparison is None or level.comparison.value is None:
        return ""
    values = (_alone(level.quantity, estimate) for estimate in (level.estimate, level.comparison.value))
    return f", {in_unit(' against '.join(values), level.quantity.unit)}"


def _most_apart(level: Level, where: str) -> Addition:
    """The largest difference of several, of which none is shown; as two values where it has no ratio."""
    form, name, end = level.quantity.form, level.quantity.name, level.estimate.value
    difference = level.difference
    if difference is None:
        return Addition(f"{name} {with_interval(level.estimate, form)}{where}")
    value = difference.estimate.value
    if difference.verdict is Verdict.SAME or value is None or end is None:
        return Addition()
    largest = f"largest difference {_signed(difference, form)}, in the {name}"
    is_one_of_many = difference.verdict is Verdict.OPEN_AMONG_MANY
    n = f", not significant among {_n_tests(difference)}" if is_one_of_many else ""
    if difference.scale is Scale.RELATIVE or form is Form.SHARE:
        return Addition(clause=f"{largest}{_in_margin(difference, form)}{n}{where}")
    places = decimals(Estimate(max(abs(end), abs(end - value))), form)
    ends = f"{name} {number(end, form, places)} against {number(end - value, form, places)}"
    if difference.verdict is Verdict.UNJUDGED:
        return Addition(f"{ends}, without an interval{where}")
    return Addition(f"{ends} (difference {interval(difference, form)}){n}{where}")


def _signed(difference: Difference, form: Form) -> str:
    """A difference with its sign and interval."""
    unit = form_of(difference, form)
    return with_interval(difference.estimate, unit, sign=True) + _AFTER[unit]


def _regime(regime: Regime) -> Clauses:
    head, things, share, (verb, *others) = regime.where.head, regime.things, regime.share, regime.predicates
    if regime.of == 1:
        return (f"{head}{things} {verb}",)
    amount = f"{regime.n:,} of {regime.of:,} {things}"
    if share.low is not None or regime.n == regime.of:
        amount = _amount(share, regime.of, things, place=" at each" * regime.is_of_each)
    return f"{head}{amount} {verb}", *((f"the others {listed(others, 'or')}",) if others else ())


def _attracting(attracting: Attracting) -> Clauses:
    names = attracting.attractors
    verb = {1: "attracts", 2: "both attract"}.get(len(names), "all attract")
    place = Place.key(attracting.key, attracting.stretch) + attracting.where
    said = f"{listed(names)} {verb}{place.tail}"
    ends = ((attracting.low_by, "lower"), (attracting.high_by, "upper"))
    refined = [(bound_in_words(by, attracting.horizon), side) for by, side in ends if by is not Bound.SETTING]
    if len({by for by, _ in refined}) == 1 and len(refined) == 2:
        return said, f"both ends are known from {refined[0][0]}"
    texts = [
        f"the {side} {verb} {by}" for (by, side), verb in zip(refined, ("end is known from", "from"), strict=False)
    ]
    return said, *((", ".join(texts),) if texts else ())


def bound_in_words(by: Bound, horizon: str) -> str:
    """How the end of a stretch is known; of runs, how long they are."""
    return f"{by.value} to t = {horizon}" if by is Bound.RUNS and horizon else by.value
