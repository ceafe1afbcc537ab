"""What each law promises beyond small strain; the head of docs/stability.md. The cases hold the laws to it."""

_PRESSED = "resists without bound towards it; the state itself (det F = 0) is caught"
_INVERTED = "caught: the logarithm or power of det F ≤ 0 is no number, and the guard stops the scene"
# A step of 1/60 s, linearized once.
_OVERSHOOTS = (
    "may overshoot in a step of 1/60 s that is linearized once, and is caught; not by Newton's method at 600 / s"
)

# By law: stretched far, pressed flat or to a point, turned inside out, rotated.
PROMISES: dict[str, tuple[str, str, str, str]] = {
    "hooke": (
        "outside of its range (strain 5 %, rotation 0.1 rad), which the status says; comes back, being linear; free it "
        "may come to rest turned, with volumes that are off, and the status says so on",
        "as stretched",
        "as stretched",
        "spurious strain; said in the status",
    ),
    "st_venant_kirchhoff": (
        "stiffens; comes back, unless it swings through rest into compression that turns an element inside out",
        "softens below a stretch of 1/√3, which the status says; caught once an element is turned inside out",
        "caught: it would stay there, and the guard stops the scene",
        "exact",
    ),
    "corotational": (
        "comes back; from 10× it may come to rest crumpled, seldom so where it is held",
        "comes back; free, quadratic tetrahedra from a point may come to rest crumpled",
        "comes back; free, quadratic tetrahedra may come to rest crumpled",
        "exact",
    ),
    "neo_hookean": (
        "comes back; softens beyond det F = e: from 10× hexahedra may come to rest crumpled, and quadratic tetrahedra "
        "be caught",
        _PRESSED,
        _INVERTED,
        "exact",
    ),
    "stable_neo_hookean": (
        f"comes back; quadratic tetrahedra from 10×, as from random places: {_OVERSHOOTS}",
        "comes back; not from a point when it is free: there its force and its stiffness are zero",
        "comes back",
        "exact",
    ),
    "mooney_rivlin": (
        f"comes back; from 10×: {_OVERSHOOTS}",
        f"{_PRESSED}; free, from 1/10: {_OVERSHOOTS}",
        _INVERTED,
        "exact",
    ),
    "ogden": (
        "comes back from 2×; with α = 12 the stress at 10× passes 10¹¹ μ: most shapes are caught",
        f"{_PRESSED}; free, from 1/10: {_OVERSHOOTS}",
        _INVERTED,
        "exact",
    ),
    "transversely_isotropic": (
        "as st venant kirchhoff",
        "as st venant kirchhoff",
        "as st venant kirchhoff",
        "exact",
    ),
    "hencky": ("comes back; no longer convex beyond a stretch of e", _PRESSED, _INVERTED, "exact"),
}
