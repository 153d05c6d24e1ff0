"""Findings in words: one function, with one case a kind."""

from __future__ import annotations

import re
from collections.abc import Iterator, Sequence
from dataclasses import replace

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
    Threshold,
    Turn,
    Verdict,
)
from stickslip.analysis.findings.numbers import bare, decimals, is_exact, number, signs, span, with_interval
from stickslip.analysis.findings.place import EVERYWHERE, Place
from stickslip.analysis.stats.estimates import Estimate

MOST_WORDS = 25  # of a first sentence; signs and numbers count


def sentence(finding: Finding) -> str:
    """A finding as a sentence of at most `MOST_WORDS` words, and what does not fit as others."""
    texts: list[str] = []
    for texts in _forms(finding):
        if len(texts[0].split()) <= MOST_WORDS:
            break
    return " ".join(f"{capital(signs(text))}." for text in texts)


def _forms(finding: Finding) -> Iterator[list[str]]:
    """A finding as clauses for a sentence each: in one, with its setting apart, and with the levels of a change."""
    yield _apart(clause(finding))
    if isinstance(finding, Outcomes):
        compared = [f"compared: {finding.scope}"] * bool(finding.scope)
        yield [*_apart(clause(replace(finding, scope=""))), *compared]
        names = (finding.different, finding.equal, finding.undecided, finding.others)
        different, equal, undecided, others = (_counted(settings) for settings in names)
        counted = replace(finding, scope="", different=different, equal=equal, undecided=undecided, others=others)
        settings = [f"settings: {', '.join(group)}" for group in names if len(group) > 1]
        yield [*_apart(clause(counted)), *compared, *settings]
        if finding.largest is not None:
            all_different = replace(counted, largest=None, different=_counted(finding.different))
            yield [*_apart(clause(all_different)), *compared, *settings, clause(finding.largest)]
        return
    where = place_of(finding)
    setting = [f"setting: {where}"] * bool(where)
    bare_finding = _anywhere(finding)
    yield [*_apart(clause(bare_finding)), *setting]
    yield [*_apart(_in_brief(bare_finding)), *setting]


def _apart(text: str) -> list[str]:
    """The first clauses of a text, as many as one sentence holds, and the others."""
    first, *others = re.split(r"; (?![^(]*\))", text)  # none in brackets
    while others and len(f"{first} {others[0]}".split()) <= MOST_WORDS:
        first = f"{first}; {others.pop(0)}"
    return [first, *others]


def place_of(finding: Finding) -> Place:
    """Where a finding holds."""
    match finding:
        case Law():
            return finding.parameter.where
        case Parts():
            return finding.whole.where
        case Decided():
            return place_of(finding.finding)
        case Outcomes() | Lack():
            return EVERYWHERE
    return finding.where


def _anywhere(finding: Finding) -> Finding:
    """A finding without where it holds."""
    match finding:
        case Law():
            return replace(finding, parameter=replace(finding.parameter, where=EVERYWHERE))
        case Parts():
            return replace(finding, whole=replace(finding.whole, where=EVERYWHERE))
        case Decided(truth, reason) if not isinstance(bare_reason := _anywhere(reason), Decided):
            return Decided(truth, bare_reason)
        case Outcomes() | Lack() | Decided():
            return finding
    return replace(finding, where=EVERYWHERE)


def _in_brief(finding: Finding) -> str:
    """As `clause`; of a change how large it is, and then from where to where."""
    match finding:
        case Decided(truth, reason):
            return f"{truth.value}: {_in_brief(reason)}"
        case Level(comparison=Comparison() as comparison) | Share(comparison=Comparison() as comparison):
            compared = _compared(comparison, finding.quantity if isinstance(finding, Level) else None)
            if compared.startswith(", "):
                return f"{clause(replace(finding, comparison=None))}; it is {compared[2:]}"
        case Law(scope=Level() as scope, things=things) if (share := scope.estimate.value) is not None:
            return f"{clause(replace(finding, scope=None))}; the law is of {_rounded(share)} of {things}"
        case Change(keys=(key, *others)) if others:
            along_with = listed([_goes(other) for other in others])
            return f"{_in_brief(replace(finding, keys=(key,)))}; with it {along_with}"
        case Change(quantity, difference=difference, turn=None):
            along = f"as {_along(finding)}{finding.where.tail}"
            match difference.verdict:
                case Verdict.MORE | Verdict.LESS:
                    verb = "rises" if difference.verdict is Verdict.MORE else "falls"
                    return f"{quantity.name} {verb} {_by(finding)} {along}; it {verb} {_from_to(finding)}"
                case Verdict.OPEN | Verdict.OPEN_AMONG_MANY:
                    brief = f"no change of the {quantity.name} is shown {along}"
                    return f"{brief}; it {_open(finding)})"
    return clause(finding)


def clause(finding: Finding) -> str:
    """A finding without capital and full stop."""
    match finding:
        case Level():
            return _level(finding)
        case Change():
            return _change(finding)
        case Share():
            return _share(finding)
        case Lifetime():
            return _lifetime(finding)
        case Law():
            return _law(finding)
        case Parts():
            return _parts(finding)
        case Alike(quantity, value, among, where):
            digits = decimals(Estimate(value), quantity.form) + (
                quantity.form is not Form.COUNT
            )  # it is known to many
            shown = number(value, quantity.form, digits) + _in(quantity)
            return f"{quantity.name}{where.tail}: {shown}, the same {among}"
        case Outcomes():
            return _outcomes(finding)
        case Threshold(subject, is_end, key, last, first, where, basis):
            in_all = "" if basis is None or basis.n == 1 else f", in all {plural(basis.n, basis.unit)}"
            ends = f"{'ends' if is_end else 'begins'} between {key} = {last} and {first}{_in(finding)}"
            return f"{subject} {ends}{where.tail}{in_all}"
        case Regime():
            return _regime(finding)
        case Attracting():
            return _attracting(finding)
        case Lack(what, reason, detail):
            return f"{what}: {reason.value}{f' ({detail})' * bool(detail)}"
        case Decided(truth, reason):
            return f"{truth.value}: {clause(reason)}"


def capital(text: str) -> str:
    """A text with a capital first letter, unless it begins with a symbol: a letter by itself, or a Greek one."""
    is_symbol = text[:1] > "\x7f" or (text[:1] not in ("a", "A") and not text[1:2].isalpha())
    return text if is_symbol else text[:1].upper() + text[1:]


def listed(names: Sequence[str], last: str = "and") -> str:
    """Names in a sentence: "a, b and c"."""
    return names[0] if len(names) == 1 else f"{', '.join(names[:-1])} {last} {names[-1]}"


def plural(n: int, noun: str) -> str:
    """A number of things: "1 run", "20 systems"."""
    return f"{n:,} {noun}{'s' * (n != 1)}"


def based_on(basis: Basis | None) -> str:
    """What a finding rests on, for a table: "20 systems"."""
    return "" if basis is None else plural(basis.n, basis.unit)


def _share(share: Share) -> str:
    is_whole = share.estimate.value in (0.0, 1.0)
    n = f" {share.n:,}" if is_whole and share.n is not None and share.n > 1 else ""
    if is_whole and share.basis is not None and share.basis.n == 1:
        which, bracket = (
            "all" if share.estimate.value else "none of the",
            f"({plural(1, share.basis.unit)}, no interval)",
        )
        return f"{which}{n} {share.things} {share.predicate}{share.where.tail} {bracket}{_compared(share.comparison)}"
    words = f"{with_interval(share.estimate, Form.SHARE)} of{n} {share.things} {share.predicate}{share.where.tail}"
    if share.comparison is None or share.comparison.difference.verdict is not Verdict.OPEN:
        return words + _compared(share.comparison)
    difference, reference = share.comparison.difference, share.comparison.other
    return f"{words}, consistent with {reference}; the difference is {_signed(difference, Form.SHARE)}"


def _level(level: Level) -> str:
    words = level.quantity.clause and _in_clause(level)
    if words:
        return level.where.head + level.quantity.clause.format(words)
    name = level.quantity.name + (f", {level.where}" if level.where else "")
    return f"{name}: {_value(level.quantity, level.estimate)}{_compared(level.comparison, level.quantity)}"


def _in(said: Quantity | KeyChange | Threshold) -> str:
    """The unit of a quantity or a key, after its value."""
    return f" {said.unit}" if said.unit else ""


def _value(quantity: Quantity, estimate: Estimate) -> str:
    """An estimate with its unit."""
    return with_interval(estimate, quantity.form) + _in(quantity)


def _in_clause(level: Level) -> str:
    """What stands in the clause of a quantity; empty where a comparison is undecided."""
    if level.comparison is None:
        return _value(level.quantity, level.estimate)
    reference, difference = level.comparison.other, level.comparison.difference
    if difference.verdict is Verdict.EQUAL:
        return f"{_within(difference, level.quantity.form)} of that for {reference}"
    if difference.verdict not in (Verdict.MORE, Verdict.LESS):
        return ""
    if (times := ratio(difference)) is not None:
        return f"{times} times as much as for {reference}"
    side = "more" if difference.verdict is Verdict.MORE else "less"
    return f"{size(difference, level.quantity.form)} {side} than for {reference}"


def _compared(comparison: Comparison | None, quantity: Quantity | None = None) -> str:
    """What a comparison adds to a sentence about an estimate."""
    if comparison is None:
        return ""
    reference, difference = comparison.other, comparison.difference
    above, less = ("above", "below") if quantity is None else (quantity.more, quantity.less)
    form = Form.SHARE if quantity is None else quantity.form
    match difference.verdict:
        case Verdict.MORE if (times := ratio(difference)) is not None:
            return f", {times} times that of {reference}"
        case Verdict.MORE:
            return f", {size(difference, form)}{_of(difference, quantity)} {above} {reference}"
        case Verdict.LESS:
            return f", {size(difference, form)}{_of(difference, quantity)} {less} {reference}"
        case Verdict.EQUAL:
            return f", {_within(difference, form)} of {reference}"
        case Verdict.SAME:
            return f", the same as {reference} in every run"
        case Verdict.OPEN:
            return f"; no difference from {reference} is shown ({interval(difference, form)})"
        case Verdict.OPEN_AMONG_MANY:
            distance = f"{reference}: {interval(difference, form)}"
            return f"; difference from {distance}, not significant among {_n_tests(difference)}"
        case Verdict.UNJUDGED:
            return f", compared with {reference}, without an interval"


def _of(difference: Difference, quantity: Quantity | None) -> str:
    """The unit of a difference, if that is not relative."""
    return "" if quantity is None or difference.scale is Scale.RELATIVE else _in(quantity)


def ratio(difference: Difference) -> str | None:
    """A relative difference of more than 100% as a ratio, "11.4 (5.8 to 22.3)"; None of any other."""
    value, low, high = difference.estimate.value, difference.estimate.low, difference.estimate.high
    if difference.scale is not Scale.RELATIVE or value is None or value < 1.0:
        return None
    ends = [None if end is None else 1.0 + end for end in (low, high)]
    return with_interval(Estimate(1.0 + value, ends[0], ends[1]))


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
    return text, "not significant among so many" * (verdict is Verdict.OPEN_AMONG_MANY)


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
    """That a difference is less than its margin, with its interval, which may lie on one side of zero."""
    unit = form_of(difference, form)
    return f"within {margin(difference, form)} ({interval(difference, form).removesuffix(_AFTER[unit])})"


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


def _change(change: Change) -> str:
    quantity, difference = change.quantity, change.difference
    along = f"as {_along(change)}{change.where.tail}"
    if change.turn is not None:
        return _turning(change, change.turn, along)
    match difference.verdict:
        case Verdict.MORE:
            return f"{quantity.name} rises {_from_to(change)}, {_by(change)}, {along}"
        case Verdict.LESS:
            return f"{quantity.name} falls {_from_to(change)}, {_by(change)}, {along}"
        case Verdict.EQUAL:
            return f"{quantity.name} stays {_within(difference, quantity.form)} {along}"
        case Verdict.SAME:
            return f"{quantity.name} is the same in every run {along}"
        case Verdict.OPEN:
            return f"{quantity.name} {_open(change)}) {along}"
        case Verdict.OPEN_AMONG_MANY:
            tests = _n_tests(difference)
            return f"{quantity.name} {_open(change)}, not significant among {tests}) {along}"
        case Verdict.UNJUDGED:
            tail = "" if change.basis is None else f"; {plural(change.basis.n, change.basis.unit)}, no interval"
            return f"{quantity.name} goes {_from_to(change)} {along}{tail}"


def _turning(change: Change, turn: Turn, along: str) -> str:
    """A change that is not one way all along."""
    name, (start, end) = change.quantity.name, _levels(change)
    unit = _in(change.quantity)
    there = f"{with_interval(turn.estimate, change.quantity.form)}{unit} near {turn.near}"
    match turn.course:
        case Course.MINIMUM:
            return f"{name} has a minimum of {there}; it falls from {start} and rises to {end}{unit} {along}"
        case Course.MAXIMUM:
            return f"{name} has a maximum of {there}; it rises from {start} and falls to {end}{unit} {along}"
        case Course.NO_TREND:
            return f"{name} changes without a trend {along}; it goes {_from_to(change)}"


def _along(change: Change) -> str:
    """What goes from where to where; of keys that are swept together, each."""
    head, *tails = change.keys
    return listed([_goes(head), *(_goes(key, "") for key in tails)])


def _goes(key: KeyChange, verb: str = " goes") -> str:
    said = key.said
    return f"{said.key}{verb} from {said.first} to {said.second}{_in(said)}"


def _open(change: Change) -> str:
    """Levels and the estimate of a change that is not shown, with a bracket that the caller closes."""
    form, difference = change.quantity.form, change.difference
    start, end = _levels(change)
    levels = (f"is {end} at both ends" if start == end else f"goes from {start} to {end}") + _in(change.quantity)
    value = difference.estimate.value
    assert value is not None
    unit = form_of(difference, form)
    text = bare(value, unit, decimals(difference.estimate, unit), sign=True)
    return f"{levels} (change {text}, {interval(difference, form)}"


def _by(change: Change) -> str:
    """By how much a quantity changes; what is the same in each unit has no interval."""
    estimate, basis = change.difference.estimate, change.basis
    if basis is not None and is_exact(estimate):
        return f"by the same in all {plural(basis.n, basis.unit)}"
    return f"by {size(change.difference, change.quantity.form)}{_of(change.difference, change.quantity)}"


def _from_to(change: Change) -> str:
    return "from {} to {}".format(*_levels(change)) + _in(change.quantity)


def _levels(change: Change) -> tuple[str, str]:
    """The quantity before and after."""
    start, end = change.before.value, change.after.value
    assert start is not None
    assert end is not None
    form, difference = change.quantity.form, change.difference
    is_absolute = difference.scale is Scale.ABSOLUTE
    places = decimals(difference.estimate if is_absolute else Estimate(max(abs(start), abs(end))), form)
    return number(start, form, places), number(end, form, places)


def _lifetime(lifetime: Lifetime) -> str:
    if lifetime.estimate.value is None:
        share = f"{number(lifetime.share_left, Form.SHARE)} of"
        where = Place.key("t", f"{lifetime.horizon:g}{_in(lifetime.quantity)}") + lifetime.where
        return f"{share} {lifetime.things} {lifetime.predicate}{where.tail}"
    name = lifetime.quantity.name + lifetime.where.tail
    value = _value(lifetime.quantity, lifetime.estimate)
    return f"{name}: {value}{_compared(lifetime.comparison, lifetime.quantity)}"


def _law(law: Law) -> str:
    level = law.parameter
    quantity = level.quantity
    name, value = law.called or quantity.name, with_interval(level.estimate, quantity.form)
    parameter = f"{name} {value}{_compared(level.comparison, quantity)}"
    share = None if law.scope is None else law.scope.estimate.value
    scope = "" if share is None else f" ({_rounded(share)} of {law.things})"
    match law.fit:
        case Fit.HOLDS:
            return f"{level.where.head}{law.subject} {law.predicate}{scope}: {parameter}"
        case Fit.CLOSE:
            predicate = law.nearly or f"nearly {law.predicate}"
            return f"{level.where.head}{law.subject} {predicate}{scope}: {parameter}"
        case Fit.FAILS:
            far = "" if law.departure is None else f" ({_level(replace(law.departure, where=EVERYWHERE))})"
            return f"{level.where.head}{law.subject} do not {law.predicate}{far}"
        case Fit.OPEN:
            return f"whether {law.subject}{level.where.tail} {law.predicate} is open; {_level(level)}"


def _rounded(share: float) -> str:
    """A share without its interval: "8.3%"."""
    return number(share, Form.SHARE, int(share < 0.995))


def _parts(sum_of: Parts) -> str:
    """What the last part does, and the others together."""
    total, *smaller, largest = sum_of.whole, *sum_of.parts
    form = total.quantity.form
    name, subject = largest.quantity.name, f"{sum_of.subject or total.quantity.name}{total.where.tail}"
    value, low, high = largest.estimate.value, largest.estimate.low, largest.estimate.high
    assert value is not None
    if low is not None and high is not None and low <= 0.0 <= high:
        words = f"no effect of {name} on the {subject} is shown ({span(low, high, form, sign=True)})"
    else:
        amount = with_interval(_without_sign(largest.estimate), form)
        words = f"{name} {'raises' if value > 0.0 else 'lowers'} the {subject} by {amount}"
    others = [level.quantity.name for level in smaller]
    verb = f"{'together' * (len(others) > 1)} contribute{'s' * (len(others) == 1)}".strip()
    return f"{words}; {listed(others)} {verb} {with_interval(sum_of.rest, form, sign=True)}"


def _outcomes(outcomes: Outcomes) -> str:
    """Settings by outcome; if there is a largest difference that is shown, it is what the sentence says first."""
    reference, largest = outcomes.other, outcomes.largest
    scope = f" in {outcomes.scope}" if outcomes.scope else ""
    words = []
    if outcomes.different and largest is not None and (distance := _larger(largest, reference)):
        words.append(f"{outcomes.at_largest} gives {distance}")
        if outcomes.others:
            words.append(f"{listed(outcomes.others)} also differ{_s(outcomes.others)}")
    elif outcomes.different:
        words.append(f"{listed(outcomes.different)} differ{_s(outcomes.different)} from {reference}")
    if outcomes.equal:
        words.append(f"{listed(outcomes.equal)} agree{_s(outcomes.equal)} with {reference}{scope}")
    if outcomes.undecided:
        undecided = listed(outcomes.undecided, "or")
        if largest is None or largest.basis is None or largest.comparison is None:
            words.append(f"{undecided} cannot be told from {reference}{scope}")
        else:
            beside = "" if outcomes.equal else f" from {reference}{scope}"
            words.append(f"no difference{beside} is shown for {undecided} ({based_on(largest.basis)})")
        if outcomes.equal:
            return "; ".join(words)
    is_distance = largest is not None and largest.comparison is None
    distance = "" if largest is None or (outcomes.different and not is_distance) else _most_apart(largest)
    if distance and outcomes.undecided and outcomes.at_largest not in ("", *outcomes.undecided):
        distance += f", for {outcomes.at_largest}"
    return "; ".join(words) + distance


def _s(settings: Sequence[str]) -> str:
    """The ending of the verb of some settings."""
    return "s" if len(settings) == 1 and not settings[0].endswith("settings") else ""


def _counted(settings: tuple[str, ...]) -> tuple[str, ...]:
    """Settings as their number, if they are several."""
    return settings if len(settings) < 2 else (f"{len(settings)} settings",)


def _larger(level: Level, other: str) -> str:
    """A difference that is shown as an object: "31% (20 to 41%) fewer slip onsets than exact"; else empty."""
    if level.comparison is None or level.comparison.difference.verdict not in (Verdict.MORE, Verdict.LESS):
        return ""
    difference, name, things = level.comparison.difference, level.quantity.name, level.quantity.things
    is_more = difference.verdict is Verdict.MORE
    if (times := ratio(difference)) is not None:
        return f"{times} times as many {things} as {other}" if things else f"{times} times the {name} of {other}"
    amount = size(difference, level.quantity.form)
    if things and difference.scale is Scale.RELATIVE:
        return f"{amount} {'more' if is_more else 'fewer'} {things} than {other}"
    return f"a {name} {amount} {'higher' if is_more else 'lower'} than {other}"


def _most_apart(level: Level) -> str:
    """The largest difference of several, of which none is shown; as two values where it has no ratio."""
    if level.comparison is None:  # a distance
        return f": {level.quantity.name} {with_interval(level.estimate, level.quantity.form)}"
    if level.comparison.difference.verdict is Verdict.SAME:
        return ""
    difference, form, name = level.comparison.difference, level.quantity.form, level.quantity.name
    value, end = difference.estimate.value, level.estimate.value
    if value is None or end is None:
        return ""
    if difference.verdict is Verdict.EQUAL:
        within = f"within the declared {margin(difference, form)}"
        return f"; largest difference {_signed(difference, form)}, in the {name}, {within}"
    is_one_of_many = difference.verdict is Verdict.OPEN_AMONG_MANY
    n = f", not significant among {_n_tests(difference)}" if is_one_of_many else ""
    if difference.scale is Scale.RELATIVE:
        return f"; largest difference {_signed(difference, form)}, in the {name}{n}"
    places = 0 if form is Form.SHARE else decimals(Estimate(max(abs(end), abs(end - value))), form)
    ends = f"{name} {number(end, form, places)} against {number(end - value, form, places)}"
    if difference.verdict is Verdict.UNJUDGED:
        return f": {ends}, without an interval"
    return f": {ends} (difference {interval(difference, form)}){n}"


def _signed(difference: Difference, form: Form) -> str:
    """A difference with its sign and interval."""
    unit = form_of(difference, form)
    return with_interval(difference.estimate, unit, sign=True) + _AFTER[unit]


def _regime(regime: Regime) -> str:
    head, things, share, (verb, *others) = regime.where.head, regime.things, regime.share, regime.predicates
    if regime.of == 1:
        return f"{head}{things} {verb}"
    amount = with_interval(share, Form.SHARE) if share.low is not None else f"{regime.n:,}"
    rest = f"; the others {listed(others, 'or')}" if others else ""
    return f"{head}{amount} of {regime.of:,} {things} {verb}{rest}"


def _attracting(attracting: Attracting) -> str:
    names = attracting.attractors
    verb = {1: "attracts", 2: "both attract"}.get(len(names), "all attract")
    place = Place.key(attracting.key, attracting.stretch) + attracting.where
    ends = ((attracting.low_by, "lower"), (attracting.high_by, "upper"))
    refined = [(bound_in_words(by, attracting.horizon), side) for by, side in ends if by is not Bound.SETTING]
    if len({by for by, _ in refined}) == 1 and len(refined) == 2:
        bounds = f"; both ends are known from {refined[0][0]}"
    else:
        texts = [
            f"the {side} {verb} {by}"
            for (by, side), verb in zip(refined, ("end is known from", "from"), strict=False)
        ]
        bounds = f"; {', '.join(texts)}" if texts else ""
    return f"{listed(names)} {verb}{place.tail}{bounds}"


def bound_in_words(by: Bound, horizon: str) -> str:
    """How the end of a stretch is known; of runs, how long they are."""
    return f"{by.value} to t = {horizon}" if by is Bound.RUNS and horizon else by.value
