"""Tables of results/ on what `diagnose` names: its own ground, foreign ones, a measured machine."""

from tools.tables import Row, digits, percent, pick, read, table


def blind() -> str:
    rows = [r for r in read("blind/blind.csv") if r["method"] == "diagnose"]
    lines = [[r["score"], r["goal"], f"{percent(r['value'])} [{percent(r['low'])}, {percent(r['high'])}]", r["of"]]
             for r in rows]  # fmt: skip
    others = [r for r in read("blind/blind.csv") if r["score"] in ("single, clear: top 1", "no effect: false alarms")]
    by = {
        m: [percent(r["value"]) for r in others if r["method"] == m] for m in dict.fromkeys(r["method"] for r in others)
    }
    simple = table(["method", "clear single effects: top 1", "false alarms"], [[m, *cells] for m, cells in by.items()])
    return table(["asked", "goal", "measured", "cases"], lines) + "\n\nBeside simpler ways:\n\n" + simple


def foreign() -> str:
    parts = []
    for file in ("foreign", "imperfect", "engines", "engines_again", "tolerated", "earlier"):
        rows = read(f"foreign/{file}.csv")
        parts.append(f"Seed {rows[0]['seed']}:\n\n{by_ground(rows)}")
    return "\n\n".join(parts)


def by_ground(rows: list[Row]) -> str:
    """Scores by ground."""
    grounds = list(dict.fromkeys(r["ground"] for r in rows))
    by = {(r["ground"], r["score"]): r for r in rows}
    lines = []
    for score in dict.fromkeys(r["score"] for r in rows):
        cells = [scored(by[g, score]) if (g, score) in by else "" for g in grounds]
        lines.append([score, next(r["goal"] for r in rows if r["score"] == score), *cells])
    return table(["asked", "goal", *(f"`{g}`" for g in grounds)], lines)


def scored(row: Row) -> str:
    """A share or a number of seconds, its interval, and of how many."""
    write = digits if "seconds" in row["score"] else percent
    return f"{write(row['value'])} [{write(row['low'])}, {write(row['high'])}] of {row['of']}"


def judgement() -> str:
    rows = read("judgement/judgement.csv")
    lines = []
    for name in dict.fromkeys(r["without"] for r in rows if "+" not in r["without"]):  # those are of fewer cases
        mine = [r for r in rows if r["without"] == name]
        right = sum(float(r[f"{g}_exact"] or 0) * int(r[f"{g}_exact_of"]) for r in mine for g in ("single", "pair"))
        wrong = sum(float(r[g] or 0) * int(r[f"{g}_of"]) for r in mine for g in ("false_alarms", "wrong_outside"))
        inside = sum(float(r["coverage"] or 0) * int(r["coverage_of"]) for r in mine)
        of = sum(int(r["coverage_of"]) for r in mine)
        changed = sum(int(r["changed"]) for r in mine)
        lines.append([f"`{name}`", changed, f"{right:.0f}", f"{wrong:.0f}", f"{inside:.0f} of {of}"])
    head = ("without", "answers that change", "exact sets", "wrong names", "intervals that cover")
    return table(head, lines)


def emps() -> str:
    head = {"data": "what", "verdict": "verdict", "named": "effects", "first half mm": "first_mm"}
    return pick(read("emps/emps.csv"), {**head, "second mm": "second_mm", "pulses mm": "pulses_mm", "s": "seconds"})
