"""Where the arm's own parts are while a frame is taken."""

from __future__ import annotations

from stereo_ore.types import KeepOut, PostureLink, Postures, Reason


def arm_places(
    stamp_ns: int | None, postures: Postures | None, link: PostureLink | None
) -> tuple[tuple[KeepOut, ...], tuple[Reason, ...]]:
    """The arm's parts at the time of a frame, and why they can't be relied on.

    Parts are taken from the postures before and after the frame, for the arm moves between them.
    Where both are older than the limit the nearest is used all the same, and there are no targets.

    Parameters
    ----------
    stamp_ns : int or None
        When the frame was taken.
    postures : Postures or None
        What the arm has told.
    link : PostureLink or None
        None: the site has no posture to look at.
    """
    if link is None:
        return (), ()
    if stamp_ns is None:
        return (), (_missing("the frame has no stamp"),)
    found = () if postures is None else postures.around(stamp_ns)
    if not found:
        return (), (_missing("the arm has told none"),)
    age_s = {posture: abs(posture.stamp_ns - stamp_ns) / 1e9 for posture in found}
    nearest = min(found, key=lambda posture: age_s[posture])
    used = [posture for posture in found if age_s[posture] <= link.max_age_s] or [nearest]
    bodies = tuple(body for posture in used for body in posture.bodies)
    if age_s[nearest] <= link.max_age_s:
        return bodies, ()
    text = f"{age_s[nearest]:.3f} s from the frame's, {link.max_age_s:g} s are allowed"
    return bodies, (Reason("POSTURE_OLD", f"no targets: the arm's nearest posture is {text}"),)


def _missing(why: str) -> Reason:
    return Reason("NO_POSTURE", f"no targets: the arm's posture is not known: {why}")
