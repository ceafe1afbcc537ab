"""What each law promises beyond small strain: the table at the top of docs/stability.md. The cases check it."""

_PRESSED = "resists without bound; caught at det F = 0"
_OVERSHOOTS = f"{_PRESSED}; free, from 1/10, may overshoot"

# By law: stretched far, pressed flat or to a point, inverted. NOTES defines *crumpled* and *overshoot*.
PROMISES: dict[str, tuple[str, str, str]] = {
    "hooke": (
        "comes back; beyond strain 5 %, rotation 0.1 rad the status warns; free, may rest rotated with wrong volumes",
        "same",
        "same",
    ),
    "st_venant_kirchhoff": (
        "stiffens; comes back unless it swings into compression that inverts an element",
        "softens below a stretch of 1/√3, and the status warns; caught once an element inverts",
        "caught: it would stay inverted",
    ),
    "corotational": (
        "comes back; from 10× may rest crumpled, rarely if fixed",
        "comes back; quadratic shapes may rest crumpled from a point",
        "comes back; quadratic shapes may rest crumpled",
    ),
    "neo_hookean": (
        "comes back; from 10× (softens beyond det F = e) hexahedra may rest crumpled, quadratic shapes be caught",
        _PRESSED,
        "caught",
    ),
    "stable_neo_hookean": (
        "comes back; pyramids and quadratic shapes may overshoot from 10×, quadratic ones from random places; "
        "quadratic hexahedra may rest crumpled",
        "comes back, except a free point: zero force and stiffness there; quadratic hexahedra may rest crumpled",
        "comes back; quadratic hexahedra may rest crumpled",
    ),
    "mooney_rivlin": ("comes back; from 10× may overshoot", _OVERSHOOTS, "caught"),
    "ogden": (
        "comes back from 2×; at 10× with α = 12 (stress above 10¹¹ μ) most shapes are caught",
        _OVERSHOOTS,
        "caught",
    ),
    "transversely_isotropic": ("as st venant kirchhoff", "same", "same"),
    "hencky": ("comes back; not convex beyond a stretch of e", _PRESSED, "caught"),
}

NOTES = (
    "* *Comes back*: to the rest shape.\n"
    "* *Caught*: a guard stops the scene. Most such laws have no energy at det F ≤ 0.\n"
    "* *Crumpled*: at rest in another equilibrium, no element inverted. The status cannot tell.\n"
    "* *Overshoot*: one linearized solve in 1/60 s goes too far, and the guard stops the scene. Newton's method at 600 "
    "steps a second comes back.\n"
    "* Rotations are exact, except with hooke: it takes them for strain, and the status warns."
)
