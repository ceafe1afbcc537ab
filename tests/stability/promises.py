"""What each law promises beyond small strain; the head of docs/stability.md. The cases hold the laws to it."""

_LOGARITHMS = (
    "resists without bound towards it; the state itself (det F = 0) is caught",
    "caught: the logarithm or power of det F ≤ 0 is no number, and the guard stops the scene",
)

_MOSTLY = "comes back; from 10×, as from random places, a coarse mesh may come to rest crumpled instead"

# By law: stretched far, pressed flat or to a point, turned inside out, rotated.
PROMISES: dict[str, tuple[str, str, str, str]] = {
    "hooke": (
        "outside of its range (strain 1 %, rotation 0.1 rad); stable, and said in the status",
        "as stretched",
        "comes back, being linear; said in the status meanwhile",
        "spurious strain; said in the status",
    ),
    "st_venant_kirchhoff": (
        "stiffens; comes back, unless it swings through rest into compression",
        "softens below a stretch of 1/√3 and may stay there; said in the status once an element is inside out",
        "stays there; said in the status",
        "exact",
    ),
    "corotational": (_MOSTLY, "comes back", "comes back", "exact"),
    "neo_hookean": ("comes back; softens beyond det F = e", *_LOGARITHMS, "exact"),
    "stable_neo_hookean": (
        _MOSTLY,
        "comes back; not from a point when it is free: there its force and its stiffness are zero",
        "comes back",
        "exact",
    ),
    "mooney_rivlin": ("comes back", *_LOGARITHMS, "exact"),
    "ogden": ("comes back; with α = 12 the stress at 10× passes 10¹¹ μ", *_LOGARITHMS, "exact"),
    "transversely_isotropic": (
        "as st venant kirchhoff",
        "as st venant kirchhoff",
        "as st venant kirchhoff",
        "exact",
    ),
    "hencky": ("comes back; no longer convex beyond a stretch of e", *_LOGARITHMS, "exact"),
}
