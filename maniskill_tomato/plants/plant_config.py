"""What a tomato plant is made of, in numbers: every one a documented parameter with its unit and source.

Sources are named short: [WUR] mean over the annotated young plants of the TomatoWUR data set; [phyllotaxis]
the study of the main shoot of wild tomato; [Helios] the tomato of the Helios plant library; [blender] the
tomato generator of fields-ignition; [Ci] Ci et al. 2024 ('Tasty Tom' truss tomato); [airobotsight] measured
cherry trusses; [yjmpc] a grower's leaf description; [practice] usual greenhouse practice; [looks] set by
comparing renders with photos.
`docs/plants.md` lists all values.
"""

from collections.abc import Callable
from dataclasses import dataclass, field, fields
from math import isfinite

from maniskill_tomato.errors import InvalidInputError

MAX_LEAF_DENSITY = 4.0


def check_positive(config: object, *names: str) -> None:
    """Refuses a config whose named numbers are not positive and finite."""
    for name in names:
        value = getattr(config, name)
        if not (isfinite(value) and value > 0):
            raise InvalidInputError(f"{type(config).__name__}.{name} must be positive, got {value}")


def check_ranges(config: object) -> None:
    """Refuses every (low, high) pair of a config that is not ascending."""
    for item in fields(config):  # type: ignore[arg-type]
        value = getattr(config, item.name)
        if item.name.endswith("_range") and not (len(value) == 2 and value[0] <= value[1]):
            raise InvalidInputError(
                f"{type(config).__name__}.{item.name} must be (low, high) with low <= high, got {value}"
            )


@dataclass(frozen=True, kw_only=True)
class StemConfig:
    """The main stem, tied up a string."""

    height: float = 1.5
    """Height of the stem's tip above the ground, in [m]; [blender] 1.25 +- 0.1, raised to the robot's working
    height."""
    base_radius: float = 0.0085
    """Radius of the stem at the ground, in [m]; [blender] 9 mm."""
    tip_radius_ratio: float = 0.42
    """Radius at the stem's tip as a share of that at the ground; [blender] 42 %."""
    internode_length: float = 0.071
    """Mean distance between nodes above the first truss, in [m]; [practice] 7-8 cm on vines tied up a string.
    """
    lower_internode_length: float = 0.053
    """Mean distance between nodes below the first truss, in [m]; [WUR] 5.3 cm on young plants."""
    internode_spread: float = 0.09
    """Standard deviation of the distance between nodes as a share of its mean; [WUR] order of its error, 6-12
    %."""
    divergence_mean_deg: float = 135.3
    """Mean angle about the stem from one leaf to the next, in [deg]; [phyllotaxis]."""
    divergence_spread_deg: float = 7.0
    """Standard deviation of that angle, in [deg]; fits the observed range of [phyllotaxis]."""
    divergence_range_deg: tuple[float, float] = (119.3, 154.7)
    """Smallest and largest of these angles, in [deg]; [phyllotaxis]."""
    nodes_below_first_truss: int = 8
    """Leaves that the stem makes before its first truss; [Helios] first flowers at node 8 or later."""
    leaves_per_truss: int = 3
    """Leaves from one truss to the next; 3 in cultivars that keep growing, [yjmpc] and [practice]."""
    wander: float = 0.008
    """How far the stem wanders to the side of its string, in slow waves, in [m]; [looks]."""
    zigzag: float = 0.0022
    """Sideways step of the stem at each node, away from the leaf, in [m]; [looks]."""
    node_swelling: float = 0.26
    """How much thicker the stem is at a node, as a share of its radius; [looks]."""

    def __post_init__(self) -> None:
        check_positive(self, "height", "base_radius", "internode_length", "lower_internode_length")
        check_positive(self, "divergence_mean_deg", "nodes_below_first_truss", "leaves_per_truss")
        if not 0 < self.tip_radius_ratio <= 1:
            raise InvalidInputError(
                f"StemConfig.tip_radius_ratio must be in (0, 1], got {self.tip_radius_ratio}"
            )
        low, high = self.divergence_range_deg
        if not low <= self.divergence_mean_deg <= high:
            raise InvalidInputError(
                f"StemConfig.divergence_range_deg must hold the mean {self.divergence_mean_deg}, "
                f"got {(low, high)}"
            )


@dataclass(frozen=True, kw_only=True)
class LeafConfig:
    """Leaves of several leaflets: pairs along the rachis and one leaflet at its tip."""

    length_range: tuple[float, float] = (0.26, 0.37)
    """Length of petiole and rachis of a grown leaf, without the leaflet at the tip, in [m]; [yjmpc] 15-45 cm
    overall."""
    insertion_deg: float = 59.0
    """Angle between the petiole and the stem above it, in [deg]; [WUR] 59."""
    insertion_spread_deg: float = 6.5
    """Standard deviation of that angle, in [deg]; [WUR] mean absolute error 6.5."""
    end_angle_range_deg: tuple[float, float] = (112.0, 150.0)
    """Direction of the rachis at its tip, as an angle to the upward vertical (90 is level, 180 hangs straight
    down), in [deg]; [looks], [Helios]."""
    sway_spread_deg: float = 9.0
    """Standard deviation of a rachis's bend to the side, in [deg]; [looks]."""
    pairs_range: tuple[int, int] = (2, 4)
    """Pairs of large side leaflets, so 5 to 9 leaflets with the one at the tip; [yjmpc] 5-9, [Helios] 7-9."""
    petiole_fraction: float = 0.30
    """Share of the leaf's stalk that is petiole: bare, from the stem to the first leaflets; [looks]."""
    leaflet_angle_deg: float = 66.0
    """Angle of a side leaflet to the rachis before it droops, in [deg]; [looks]."""
    leaflet_angle_spread_deg: float = 7.0
    """Standard deviation of that angle, in [deg]; [Helios] 10."""
    leaflet_roll_spread_deg: float = 13.0
    """Standard deviation of a leaflet's turn about its middle vein, in [deg]; [Helios] +-20."""
    leaflet_stalk: float = 0.016
    """Length of a side leaflet's own stalk, in [m]; [looks]."""
    petiole_radius: float = 0.0026
    """Radius of the petiole at the stem, in [m]; [Helios] 2-2.5 mm."""
    leaflet_length_range: tuple[float, float] = (0.118, 0.155)
    """Length of the leaflet at the tip, in [m]; [Helios] 0.12-0.18, [looks]."""
    lateral_scale: float = 0.82
    """Length of the largest side leaflets as a share of that of the leaflet at the tip; [Helios] 0.7-0.9."""
    leaflet_aspect: float = 0.68
    """Width of a leaflet as a share of its length; [Helios] 0.5-0.6; [looks]."""
    lobes_per_side: float = 3.5
    """Lobes or large teeth on each side of a leaflet; [yjmpc] lobed, uneven; [looks]."""
    lobe_depth: float = 0.36
    """Depth of the notches between lobes as a share of half the leaflet's width, near its base; they are
    shallower towards the tip; [looks]."""
    leaflet_curl_range_deg: tuple[float, float] = (25.0, 65.0)
    """How far a leaflet's middle vein turns downward from base to tip, in [deg]; [Helios] strongly bent down;
    [looks]."""
    leaflet_droop_range: tuple[float, float] = (0.25, 0.75)
    """Pull of gravity on a leaflet's direction: its weight where the leaflet's own direction has weight 1;
    [looks]."""
    fold: float = 0.16
    """How far each half of a leaflet rises from the middle vein to the edge, as a share of half its width;
    [Helios] 0.1."""
    lateral_curve: float = 0.42
    """How far the edge of a leaflet is bent down, as a share of half its width; [Helios] 0.3 to 0.8."""
    waviness: float = 0.10
    """Height of the waves of a leaflet's edge as a share of half its width; [looks]."""
    intercalary_per_gap: int = 1
    """Pairs of small leaflets between two large pairs; [yjmpc] uneven in size; [looks]."""
    intercalary_scale: float = 0.24
    """Length of a small leaflet as a share of that of the leaflet at the tip; [looks]."""
    young_leaves: int = 5
    """Leaves below the stem's tip that are still growing; [looks]."""
    youngest_size: float = 0.34
    """Size of the youngest leaf as a share of a grown one; [looks]."""

    def __post_init__(self) -> None:
        check_ranges(self)
        check_positive(self, "leaflet_aspect", "lateral_scale", "petiole_radius", "lobes_per_side")
        if not 1 <= self.pairs_range[0] <= self.pairs_range[1] <= 4:
            raise InvalidInputError(f"LeafConfig.pairs_range must lie in 1 to 4, got {self.pairs_range}")


@dataclass(frozen=True, kw_only=True)
class TrussConfig:
    """Trusses: a peduncle with pedicels to the right and left in turn."""

    azimuth_spread_deg: float = 38.0
    """Standard deviation of the direction in which a truss grows about that of the aisle (-x), in [deg];
    [practice] trusses hang to the aisle."""
    insertion_deg: float = 74.0
    """Angle between the peduncle and the stem above it, in [deg]; [looks], [Helios] 20 below level after
    bending."""
    end_angle_deg: float = 172.0
    """Direction of the peduncle at its tip, as an angle to the upward vertical (180 hangs straight down), in
    [deg]; the fruits pull it down; [looks]."""
    base_length: float = 0.055
    """Length of the peduncle from the stem to the first pedicel, in [m]; [airobotsight] 170 mm for a whole
    truss; [looks]."""
    pedicel_spacing: float = 0.026
    """Distance between pedicels along the peduncle, in [m]; [airobotsight] 170 mm for 6-8 fruits."""
    base_radius: float = 0.0033
    """Radius of the peduncle at the stem, in [m]; [Ci] 7 mm across when ripe."""
    tip_radius_ratio: float = 0.58
    """Radius at the peduncle's tip as a share of that at its base; [airobotsight] 1.9 of 3.3 mm."""
    pedicel_length_range: tuple[float, float] = (0.024, 0.034)
    """Length of a pedicel from peduncle to calyx, in [m]; [looks]."""
    pedicel_angle_deg: float = 62.0
    """Angle of a pedicel to the peduncle where it leaves, in [deg]; [looks]."""
    pedicel_angle_spread_deg: float = 9.0
    """Standard deviation of that angle, in [deg]; [looks]."""
    fruit_drop: float = 0.045
    """How far a single fruit hangs below the node of its truss, in [m]; the nodes are placed by it where
    `fruit_heights` are given."""
    pedicel_radius: float = 0.0015
    """Radius of a pedicel, in [m]; [Helios] 1.5 mm."""
    knuckle_fraction: float = 0.55
    """Where the knuckle sits on the pedicel, as a share of the way from peduncle to calyx; [looks]."""
    knuckle_swelling: float = 0.75
    """How much thicker the pedicel is at its knuckle, as a share of its radius; [looks]."""
    sepals: int = 5
    """Sepals of a calyx; a tomato flower has five."""
    sepal_length: float = 1.0
    """Length of a sepal as a share of the fruit's radius; [looks]."""
    sepal_width: float = 0.0056
    """Width of a sepal on a fruit of 30 mm radius, in [m]; [looks]."""
    sepal_curl: float = 0.95
    """Mean upward bend of a sepal from base to tip, in [rad]; [looks]."""
    sepal_curl_spread: float = 0.45
    """Standard deviation of that bend, in [rad]; [looks]."""

    def __post_init__(self) -> None:
        check_ranges(self)
        check_positive(self, "base_length", "pedicel_spacing", "base_radius", "pedicel_radius", "sepals")
        check_positive(self, "sepal_length", "sepal_width")


@dataclass(frozen=True, kw_only=True)
class FlowerConfig:
    """Flowers of a truss that has no fruit yet."""

    count_range: tuple[int, int] = (4, 8)
    """Open flowers of a truss; [practice] as many as fruits or a few more."""
    spacing: float = 0.014
    """Distance between flowers along the peduncle, in [m]; [looks]."""
    pedicel_length_range: tuple[float, float] = (0.012, 0.02)
    """Length of a flower's stalk, in [m]; [looks]."""
    end_angle_deg: float = 120.0
    """Direction of the peduncle at its tip, as an angle to the upward vertical, in [deg]; no fruit pulls at it
    yet; [looks]."""
    bud_radius: float = 0.0025
    """Radius of what the sepals and petals stand on, in [m]; [looks]."""
    sepal_length: float = 0.009
    """Length of a sepal, in [m]; [looks]."""
    petal_length_range: tuple[float, float] = (0.009, 0.013)
    """Length of a petal, in [m]; [looks]."""
    petal_width: float = 0.005
    """Largest width of a petal, in [m]; [looks]."""
    petal_bend_deg: float = 110.0
    """How far a petal bends backwards from its base to its tip, in [deg]; [looks]."""
    petal_bend_spread_deg: float = 25.0
    """Standard deviation of that bend, in [deg]; [looks]."""
    anther_length: float = 0.008
    """Length of the yellow cone in the middle of a flower (its anthers), in [m]; [looks]."""


@dataclass(frozen=True, kw_only=True)
class FruitConfig:
    """Fruits: their size and shape, and how ripe they are."""

    radius_range: tuple[float, float] = (0.026, 0.033)
    """Radius of a grown fruit where it is widest, in [m]; truss tomatoes are 50-65 mm across."""
    oblateness_range: tuple[float, float] = (0.86, 0.95)
    """Height of a fruit as a share of its width; slightly flattened round type; [looks]."""
    ribs_range: tuple[int, int] = (5, 7)
    """Number of ribs; each shows one of the chambers within, of which truss tomatoes have few."""
    rib_depth_range: tuple[float, float] = (0.004, 0.018)
    """Depth of the ribs near the calyx as a share of the radius; [looks]."""
    shoulder_dent: float = 0.14
    """Depth of the dent around the calyx as a share of the radius; [looks]."""
    tilt_spread_deg: float = 9.0
    """Standard deviation of the tilt of a fruit at the end of its pedicel, in [deg]; [looks]."""
    truss_ripening_step: float = 0.30
    """How much less ripe the next truss above is, ripeness being 0 to 1; about 8 days a truss, [practice]."""
    fruit_ripening_step: float = 0.055
    """How much less ripe the next fruit is, going outward from the stem; [practice]."""
    ripeness_spread: float = 0.05
    """Standard deviation of a fruit's ripeness; [looks]."""
    ripe_above: float = 0.62
    """Ripeness from which a fruit is red all over; between it and `turning_above` it is turning."""
    turning_above: float = 0.34
    """Ripeness from which a fruit is no longer green."""

    def __post_init__(self) -> None:
        check_ranges(self)
        if not 0 < self.turning_above < self.ripe_above <= 1:
            raise InvalidInputError(
                "FruitConfig must have 0 < turning_above < ripe_above <= 1, "
                f"got {self.turning_above} and {self.ripe_above}"
            )
        if self.radius_range[0] <= 0:
            raise InvalidInputError(f"FruitConfig.radius_range must be positive, got {self.radius_range}")


@dataclass(frozen=True, kw_only=True)
class HidingConfig:
    """Leaves that overlap a fruit on the robot's side, as on the thesis's plants (Fig. 5-5, 5-18).

    Angles are seen from the fruit: azimuth from the robot's side (-x), positive towards +y; elevation upward.
    All values are chosen so that a start pose of the thesis sees little of the fruit and the arm can reach a
    full view.
    """

    gap_range: tuple[float, float] = (0.010, 0.034)
    """Gap between the fruit's skin and the leaflet that hangs before it, in [m]."""
    offset_range: tuple[float, float] = (0.000, 0.032)
    """Shift of that leaflet away from the side that stays clear, in [m]."""
    covered_views_deg: tuple[tuple[float, float], ...] = (
        (0.0, 0.0),
        (-22.0, 4.0),
        (12.0, 4.0),
        (-10.0, 20.0),
    )
    """Views that a leaf is hung to cover, each by its azimuth and elevation, in [deg]."""
    attempts: int = 8
    """Leaves tried for each fruit; the one is taken that best covers these views and leaves the clear
    direction open."""
    clear_right_share: float = 0.75
    """Share of the fruits whose clear side is -y, to which the thesis's guided exploration (Eq. 5-6) leads.
    """
    clear_azimuth_range_deg: tuple[float, float] = (36.0, 62.0)
    """Angle between the clear direction and the robot's side, in [deg]."""
    clear_elevation_range_deg: tuple[float, float] = (-36.0, -10.0)
    """Elevation of the clear direction, in [deg]; negative is from below, where leaves hang open."""
    truss_spread_deg: float = 10.0
    """Standard deviation of the direction of a truss about that of the leaf above it, in [deg]; it hangs under
    the leaf."""
    truss_lean: float = 0.8
    """Trusses lean towards the aisle: what remains of a truss's angle to the robot's side, as a share;
    [practice]."""
    plant_turn_spread_deg: float = 9.0
    """Standard deviation of the direction of the leaf above the middle fruit about the robot's side, in [deg].
    """
    clear_half_angle_deg: float = 8.0
    """The corridor along the clear direction, which other leaves leave free, widens away from the fruit by
    this angle to each side, in [deg]."""
    clear_share: float = 0.95
    """Share of the fruit that the covering leaf must leave open in the clear direction."""
    curtain_clear_share: float = 0.80
    """Radius of the corridor that the side leaflets of the covering leaf leave free, as a share of the fruit's
    radius."""

    def __post_init__(self) -> None:
        check_ranges(self)
        check_positive(self, "attempts", "clear_half_angle_deg")
        if not self.covered_views_deg:
            raise InvalidInputError("HidingConfig.covered_views_deg must name at least one view")


@dataclass(frozen=True, kw_only=True)
class PlantConfig:
    """A whole plant."""

    name: str = "full"
    """Name of the preset, kept in `Plant.preset`."""
    stem: StemConfig = field(default_factory=StemConfig)
    """Numbers of the main stem."""
    leaf: LeafConfig = field(default_factory=LeafConfig)
    """Numbers of the leaves."""
    truss: TrussConfig = field(default_factory=TrussConfig)
    """Numbers of the trusses."""
    fruit: FruitConfig = field(default_factory=FruitConfig)
    """Numbers of the fruits."""
    flower: FlowerConfig = field(default_factory=FlowerConfig)
    """Numbers of the flowers."""
    fruits_per_truss: tuple[int, ...] = (6, 6, 5, 4, 2)
    """Fruits of each truss, from the lowest up; about 8 on cocktail and 6-7 on plum trusses before some are
    cut off; [practice]."""
    fruit_heights: tuple[float, ...] = ()
    """Heights of the fruits above the ground where each truss carries a single one, in [m]; empty leaves them
    free."""
    fruit_height_spread: float = 0.0
    """Heights are drawn evenly from so far below to so far above `fruit_heights`, in [m]."""
    hiding: HidingConfig | None = None
    """How leaves hang before the fruits, on the thesis's plants with one fruit a truss; None leaves the leaves
    where they grow."""
    leaves_kept_below_truss: int = 0
    """Leaves left below the lowest truss; growers take them off as it ripens; [practice]."""
    leaf_density: float = 1.0
    """Foliage as a multiple of the preset's: at 0 there is none; below 1, leaves and leaflets are left out;
    above 1, leaves of side shoots are added, at 4 three to a node."""
    shoots: int = 1
    """Shoots from the ground: 1 for a vine, more for a bush."""
    shoot_lean_range_deg: tuple[float, float] = (6.0, 24.0)
    """Lean of a bush's shoots away from its middle, in [deg]; [looks]."""
    wilted_share: float = 0.0
    """Share of the leaves that are dying: they hang, are rolled up and yellow."""
    flowering_trusses: int = 0
    """Trusses in flower above those with fruits, as far as the stem's height leaves room for them."""
    clutter: int = 0
    """Things about the plant that are not part of it: boards, boxes, strings, loose triangles."""

    def __post_init__(self) -> None:
        check_ranges(self)
        if not (isfinite(self.leaf_density) and 0 <= self.leaf_density <= MAX_LEAF_DENSITY):
            raise InvalidInputError(
                f"leaf_density must be a number from 0 (no leaves) to {MAX_LEAF_DENSITY:g}, "
                f"got {self.leaf_density}"
            )
        if not 1 <= self.shoots <= 8:
            raise InvalidInputError(f"shoots must be from 1 to 8, got {self.shoots}")
        if self.shoots > 1 and self.hiding is not None:
            raise InvalidInputError("hiding needs a single shoot; leave shoots at 1")
        if not 0.0 <= self.wilted_share <= 1.0:
            raise InvalidInputError(f"wilted_share must be from 0 to 1, got {self.wilted_share}")
        if not 0 <= self.flowering_trusses <= 4:
            raise InvalidInputError(f"flowering_trusses must be from 0 to 4, got {self.flowering_trusses}")
        if not 0 <= self.clutter <= 40:
            raise InvalidInputError(f"clutter must be from 0 to 40, got {self.clutter}")
        if (
            not self.fruits_per_truss
            or any(n < 0 for n in self.fruits_per_truss)
            or not sum(self.fruits_per_truss)
        ):
            raise InvalidInputError(
                "fruits_per_truss must name at least one fruit and no negative count, "
                f"got {self.fruits_per_truss}"
            )
        if self.fruit_heights:
            if len(self.fruit_heights) != len(self.fruits_per_truss) or set(self.fruits_per_truss) != {1}:
                raise InvalidInputError(
                    "fruit_heights needs one height per truss and one fruit on each; "
                    f"got {self.fruit_heights} for fruits_per_truss {self.fruits_per_truss}"
                )
            if list(self.fruit_heights) != sorted(self.fruit_heights) or self.fruit_heights[0] < 0.3:
                raise InvalidInputError(
                    f"fruit_heights must ascend from 0.3 m or more, got {self.fruit_heights}"
                )
        if self.hiding is not None and not self.fruit_heights:
            raise InvalidInputError("hiding needs fruit_heights; give a height per truss")


def make_one_tomato_config() -> PlantConfig:
    """The thesis's first training plant (5-1): one ripe tomato under overlapping leaves."""
    return PlantConfig(
        name="one_tomato",
        stem=StemConfig(height=1.42),
        fruit=FruitConfig(radius_range=(0.0305, 0.0345)),
        fruits_per_truss=(1,),
        fruit_heights=(0.775,),
        fruit_height_spread=0.06,
        hiding=HidingConfig(),
    )


def make_three_tomatoes_config() -> PlantConfig:
    """The thesis's second training plant (5-2): three ripe tomatoes at different heights under overlapping
    leaves."""
    return PlantConfig(
        name="three_tomatoes",
        stem=StemConfig(height=1.46),
        fruit=FruitConfig(radius_range=(0.029, 0.0345), truss_ripening_step=0.0),
        fruits_per_truss=(1, 1, 1),
        fruit_heights=(0.62, 0.80, 0.98),
        fruit_height_spread=0.02,
        hiding=HidingConfig(),
    )


def make_full_config() -> PlantConfig:
    """A whole greenhouse plant: five trusses from ripe to green and all its foliage."""
    return PlantConfig(name="full", leaves_kept_below_truss=1)


PRESETS: dict[str, Callable[[], PlantConfig]] = {
    "one_tomato": make_one_tomato_config,
    "three_tomatoes": make_three_tomatoes_config,
    "full": make_full_config,
}
"""The plants of the thesis by name."""
