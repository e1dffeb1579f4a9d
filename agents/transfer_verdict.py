"""Sentences of agents.transfer: in which settings a player keeps its score, what accuracy costs, counts over tasks."""

from __future__ import annotations

from collections.abc import Iterator, Sequence

from flockenv.evaluation.report import Results, interval_text

__all__ = [
    "NOTHING", "SURVIVES", "cheapest_accurate", "count_text", "kept_text", "length_text", "lost_settings",
    "most_accurate", "settings_of_note", "title", "verdict", "worst_setting",
]  # fmt: skip

SURVIVES = 0.95
"""A player survives a setting if it keeps this share of its lead over random."""
LEAST_ROUNDS = 3
"""Rounds of timing below which times are not compared."""
NOTHING = 1e-6
"""mm: an error below this is rounding."""


# --- choices of settings ----------------------------------------------------------------------------------------------


def worst_setting(results: Results, player: str) -> str | None:
    """Return the setting, except the trained one, in which a player keeps the least; None if shares are unknown."""
    others = {name: about["players"][player] for name, about in results["settings"].items()}
    others.pop(results["trained"])
    shares = {name: found["kept"] for name, found in others.items() if "kept" in found}
    return min(shares, key=lambda name: shares[name]) if shares else None


def lost_settings(results: Results, player: str) -> list[str]:
    """Return the settings in which a player keeps less than SURVIVES of its lead over random, the worst first."""
    shares = {name: about["players"][player].get("kept", 1.0) for name, about in results["settings"].items()}
    return sorted((name for name, share in shares.items() if share < SURVIVES), key=lambda name: shares[name])


def most_accurate(results: Results) -> str:
    """Return the cheapest of the settings whose error is within a tenth of the least, or is rounding."""
    settings = results["settings"]
    least = max(NOTHING, 1.1 * min(about["error_mm"] for about in settings.values()))
    return _cheapest(settings, least)


def cheapest_accurate(results: Results) -> str:
    """Return the cheapest setting that has at most a tenth of the error of the trained one."""
    settings = results["settings"]
    least = min(about["error_mm"] for about in settings.values())
    return _cheapest(settings, max(NOTHING, least, settings[results["trained"]]["error_mm"] / 10))


def _cheapest(settings: Results, error_mm: float) -> str:
    enough = [name for name, about in settings.items() if about["error_mm"] <= error_mm]
    return min(enough, key=lambda name: settings[name]["us_per_s"])


def settings_of_note(results: Results) -> dict[str, list[str]]:
    """Return the settings that the page shows, the trained one first, each with the reasons for which it is shown."""
    shown: dict[str, list[str]] = {results["trained"]: ["trained"]}
    for player in results["again"]:
        if (worst := worst_setting(results, player)) is not None:
            shown.setdefault(worst, []).append(f"worst for {player}")
    shown.setdefault(cheapest_accurate(results), []).append("a tenth of the error")
    shown.setdefault(most_accurate(results), []).append("least error")
    return shown


# --- sentences about a task -------------------------------------------------------------------------------------------


def verdict(task: str, results: Results) -> str:
    """Return sentences on the last player: whether it keeps its score, and what accuracy costs."""
    settings, trained = results["settings"], results["settings"][results["trained"]]
    pilot = list(trained["players"])[-1]
    best, cheap = most_accurate(results), cheapest_accurate(results)
    fine, saving = settings[best], settings[cheap]
    text = f"Solved to {length_text(fine['error_mm'])} ({title(fine)}; trained: {length_text(trained['error_mm'])})"
    rates = [about["players"][pilot]["success_rate"] for about in (fine, trained)]
    change = f"{_change(fine['players'][pilot])}, success {rates[0]:.0%} against {rates[1]:.0%}"
    cost = (
        f"At most a tenth of the trained error ({title(saving)}: {length_text(saving['error_mm'])}) costs "
        + _times(saving, trained)
        + (f"; the least error costs {_times(fine, trained)}" if best != cheap else "; no other has less error")
    )
    claims = f"{task}: {_survival(results, pilot)}. {text} it {change}, and {_standing(fine, pilot)}."
    return f"{claims} {cost}." if results["rounds"] >= LEAST_ROUNDS else claims


def _survival(results: Results, pilot: str) -> str:
    """Return, in words, the settings that the pilot does not survive, and the least that others keep of their leads."""
    worst, lost = worst_setting(results, pilot), lost_settings(results, pilot)
    others = ", ".join(_least_kept(results, name) for name in results["again"] if name != pilot).strip(", ")
    if worst is None:
        return f"{pilot} has no lead over random that it could keep" if len(results["settings"]) > 1 else (
            f"{pilot} played the trained setting alone"
        )  # fmt: skip
    if not lost:
        least = f"it keeps at least {kept_text(results, worst, pilot)} of its lead over random"
        text = f"{pilot} survives every setting: {least} ({title(results['settings'][worst])})"
    else:
        named = [f"{title(results['settings'][name])} (keeps {kept_text(results, name, pilot)}" for name in lost]
        rest = len(results["settings"]) - 1 - len(lost)
        text = f"{pilot} does not survive {'), '.join([named[0] + ' of its lead over random', *named[1:]])})"
        text += f"; it survives the other {rest} settings" if rest else ""
    return f"{text}; {others}" if others else text


def _least_kept(results: Results, player: str) -> str:
    worst = worst_setting(results, player)
    if worst is None:
        return ""
    return f"{player} at least {kept_text(results, worst, player)} ({title(results['settings'][worst])})"


def kept_text(results: Results, setting: str, player: str) -> str:
    """Return the share of the lead over random that a player keeps in a setting: '96 % [92, 99]'."""
    found = results["settings"][setting]["players"][player]
    value, low, high = (100 * found[key] for key in ("kept", "kept_low", "kept_high"))
    return f"{value:.0f} % [{low:.0f}, {high:.0f}]"


def _change(player: Results) -> str:
    if not player["separated"]:
        return f"is level with itself, {interval_text(player, 'difference', 'ci')}"
    verb = "gains" if player["difference"] > 0 else "loses"
    sign = 1.0 if player["difference"] > 0 else -1.0
    low, high = sorted((sign * player["ci_low"], sign * player["ci_high"]))
    size = {"difference": sign * player["difference"], "ci_low": low, "ci_high": high}
    return f"{verb} {interval_text(size, 'difference', 'ci')}"


def _standing(about: Results, pilot: str) -> str:
    """Return a comparison of the policy with the last of the other players, in words."""
    if not about["leads"]:
        return "no other player took part"
    pair, lead = list(about["leads"].items())[-1]
    place = "level with" if not lead["separated"] else "ahead of" if lead["difference"] > 0 else "behind"
    return f"is {place} {pair.removeprefix(f'{pilot} - ')} ({interval_text(lead, 'difference', 'ci')})"


def _times(about: Results, trained: Results) -> str:
    alike = about["us_low"] <= trained["us_high"] and trained["us_low"] <= about["us_high"]
    ratio = about["us_per_s"] / trained["us_per_s"]
    return f"{ratio:.2f} times the time" + (" (rounds overlap)" if alike else "")


def title(about: Results) -> str:
    """Return a setting as text: 'rk4, dt 0.0125 s'."""
    precision = " float32" if about["dtype"] == "float32" else ""
    return f"{about['method']}{precision}, dt {about['dt']:.4g} s"


def length_text(millimetres: float) -> str:
    """Return a length as text: '74 mm', '0.66 mm' or, below NOTHING, 'rounding'."""
    return (
        "rounding"
        if millimetres < NOTHING
        else f"{millimetres:.2g} mm"
        if millimetres < 100
        else f"{millimetres:.0f} mm"
    )


# --- all tasks --------------------------------------------------------------------------------------------------------


def count_text(tasks: Results) -> str:
    """Return the first paragraph of the page: in how many tasks players survive, where not, and what accuracy costs."""
    players = list(dict.fromkeys(name for about in tasks.values() for name in reversed(about["again"])))
    lines = [line for player in players for line in _player_lines(tasks, player)]
    if min(about["rounds"] for about in tasks.values()) < LEAST_ROUNDS:
        return " ".join(lines)
    ratios = [
        about["settings"][cheapest_accurate(about)]["us_per_s"] / about["settings"][about["trained"]]["us_per_s"]
        for about in tasks.values()
    ]
    cost = f"{min(ratios):.2f} to {max(ratios):.2f}" if len(ratios) > 1 else f"{ratios[0]:.2f}"
    return " ".join([*lines, f"At most a tenth of the trained error costs {cost} times the time."])


def _player_lines(tasks: Results, player: str) -> Iterator[str]:
    """Yield the sentences about one player: counts, exceptions by name, and settings with less error than trained."""
    played = {task: about for task, about in tasks.items() if _has_shares(about, player)}
    if not played:
        return
    lost = {task: lost_settings(about, player) for task, about in played.items()}
    safe = [task for task, names in lost.items() if not names]
    close = _close_calls(played, safe, player)
    yield f"**{player}** survives every setting in {len(safe)} of {len(played)} tasks{close}."
    failed = [
        f"{task} under " + ", ".join(f"{title(played[task]['settings'][n])} ({kept_text(played[task], n, player)})"
                                     for n in names)
        for task, names in lost.items() if names
    ]  # fmt: skip
    if failed:
        yield f"It does not survive: {'; '.join(failed)}."
        exact = [task for task, names in lost.items() if not _at_most_trained_error(played[task], names)]
        yield f"In settings without more error than the trained one it survives in {len(exact)} of {len(played)}."


def _has_shares(about: Results, player: str) -> bool:
    return player in about["again"] and worst_setting(about, player) is not None


def _close_calls(played: Results, safe: Sequence[str], player: str) -> str:
    """Return, in words, the number of tasks in which a setting is survived only within its interval."""
    close = [
        task for task in safe
        if any(s["players"][player].get("kept_low", 1.0) < SURVIVES for s in played[task]["settings"].values())
    ]  # fmt: skip
    return f" (in {', '.join(close)} an interval reaches below {SURVIVES:.0%})" if close else ""


def _at_most_trained_error(about: Results, names: Sequence[str]) -> list[str]:
    most = about["settings"][about["trained"]]["error_mm"]
    return [name for name in names if about["settings"][name]["error_mm"] <= most]
