"""Cards of plans: what is in a picture, what is out, and why."""

from diffopt.planning.plans import Plan, _duration
from diffopt.previews import markup


def card(plan: Plan) -> markup.Markup:
    """HTML of a plan; rows of effects that are out are set back."""
    columns = ("effect", "in or out", "because", "settings", "without it", "share of cost")
    rows = [
        (
            row.effect,
            "in" if row.included else "out",
            row.because,
            row.settings,
            "" if row.bound is None else f"{row.bound:.2%}",
            f"{row.share:.0%}" if row.included and row.share else "",
        )
        for row in plan.rows
    ]
    out = [k for k, row in enumerate(plan.rows) if not row.included]
    pairs = [
        ("level", plan.settings.level),
        ("predicted time", f"some {_duration(plan.seconds)}, without compilation, on two cores"),
        ("left out together", f"changes the mean luminance by at most {plan.bias:.2%}"),
        ("noise", f"{plan.noise:.2%} of the mean luminance"),
    ]
    title = f"Plan for a tolerance of {plan.tolerance:g}"
    title += f": {len(rows) - len(out)} effects in, {len(out)} out"
    return markup.card(
        title, None, markup.key_figures(pairs), markup.table(columns, rows, dimmed=out)
    )
