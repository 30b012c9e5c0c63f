"""The introducer sheath: a frictionless guide that holds the shaft straight."""

from dm_control import composer, mjcf

from cathsim_dmc.entities.contact import sheath_contact

CLEARANCE = 0.35e-3  # m between the device and each side of the bore
# Thickness of the sides, m: their front covers the hole in the cap of the inlet, and
# a loaded shaft cannot tunnel through them.
_WALL = 8e-3
_VISIBLE_WALL = 0.4e-3  # m, as drawn
_COLOUR = (0.35, 0.45, 0.6, 0.35)


class Sheath(composer.Entity):
    """A square bore along -z, its mouth at the origin of the entity.

    Published and real followers grip the device just outside the sheath and support
    it up to there; the bore reaches back over the whole chain and stands for both.
    Friction of clamps and valve is not modelled ("perfect motion"), so the bore has
    none.
    """

    def _build(
        self,
        length: float,
        device_radius: float,
        name: str = "sheath",
    ):
        """Builds the four sides of the bore.

        Args:
          length: of the bore, m.
          device_radius: outer radius of the device it guides, m.
          name: of the entity.
        """
        self._bore_half_width = device_radius + CLEARANCE
        self._length = length
        self._mjcf_root = mjcf.RootElement(model=name)
        self._body = self._mjcf_root.worldbody.add("body", name="bore")
        reach = self._bore_half_width + _WALL / 2
        for side, (x, y) in {
            "right": (1, 0),
            "left": (-1, 0),
            "top": (0, 1),
            "bottom": (0, -1),
        }.items():
            self._body.add(
                "geom",
                name=side,
                type="box",
                pos=(x * reach, y * reach, -length / 2),
                size=(
                    _WALL / 2 if x else self._bore_half_width + _WALL,
                    _WALL / 2 if y else self._bore_half_width + _WALL,
                    length / 2,
                ),
                **sheath_contact(),
                mass=0,
                group=3,
            )
        self._body.add(
            "geom",
            name="tube",
            type="cylinder",
            pos=(0, 0, -length / 2),
            size=(self._bore_half_width + _VISIBLE_WALL, length / 2),
            contype=0,
            conaffinity=0,
            mass=0,
            group=2,
            rgba=_COLOUR,
        )

    @property
    def mjcf_model(self) -> mjcf.RootElement:
        """The MJCF model of the sheath."""
        return self._mjcf_root

    @property
    def body(self):
        """The one static body of the sheath."""
        return self._body

    @property
    def length(self) -> float:
        """Length of the bore, m."""
        return self._length

    @property
    def bore_half_width(self) -> float:
        """Half the inner width of the bore, m."""
        return self._bore_half_width
