"""Names of the weights in the order of the tensors that hold them; counts and slices follow from the names."""

from __future__ import annotations

DISTANCES, ANGLES, GEODESICS = ("dist1", "dist3", "dist5"), ("angle1", "angle3", "angle5"), ("geo1", "geo3", "geo5")
SHAPE = (*DISTANCES, *ANGLES, *GEODESICS)  # L1..L9, invariant to motions of either scan
STATIC = (*SHAPE, "radius", "translation")  # L1..L11, independent of the estimated motions
LOCAL_CHANNELS = (*STATIC, "registered_translation")  # L1..L12
SHAPE_CHANNELS, STATIC_CHANNELS = len(SHAPE), len(STATIC)

BOOSTING = ("data_boosting", "outlier_boosting")
ASSOCIATION_DECISIONS = ("excess", "gate", "outlier_bias")  # extensions: nearest or another point, distance limit
CLUSTERING_DECISIONS = ("gate", "outlier_bias")
ASSOCIATION_FREE_SPACE = ("outlier_seen_through", "outlier_hidden")
CLUSTERING_FREE_SPACE = ("seen_through", "seen_through_back", "hidden", "hidden_back", "outlier_seen_through", "outlier_hidden")

ASSOCIATION_NODE = (*LOCAL_CHANNELS, *BOOSTING, *ASSOCIATION_DECISIONS, *ASSOCIATION_FREE_SPACE)
SCALED_EDGES = ("pairwise_distance", "pairwise_translation")  # those that have a scale
ASSOCIATION_EDGE = ("sequence", "pairwise_outlier", *SCALED_EDGES)
ASSOCIATION_WEIGHTS = (*ASSOCIATION_NODE, *ASSOCIATION_EDGE)  # a01..a14, the extensions, a15..a18

PAPERS_CLUSTER = ("cluster_distance", "outlier", "cluster_inlier_in", "cluster_inlier_out")
ELASTIC = ("neighbour_stiffness_same", "neighbour_stiffness_different", "neighbour_distance_same")  # of the partners' distance
CLUSTERING_EXTENSION = (*CLUSTERING_DECISIONS, *CLUSTERING_FREE_SPACE, "reach")
CLUSTERING_NODE = (*PAPERS_CLUSTER, *CLUSTERING_EXTENSION)
CLUSTERING_EDGE = (
    *("sequence", "neighbour_weight_same", "neighbour_weight_different", *ELASTIC),
    *("neighbour_distance_different", "pairwise_outlier"),
)
CLUSTERING_WEIGHTS = (*CLUSTERING_NODE, *CLUSTERING_EDGE)  # c01..c04, the extensions, c05..c12

ASSOCIATION_UNARY, CLUSTERING_UNARY = len(ASSOCIATION_NODE), len(CLUSTERING_NODE)  # weights of nodes; the rest are those of edges
FREE_SPACE_WEIGHTS = (
    *(f"association.{name}" for name in ASSOCIATION_FREE_SPACE),
    *(f"clustering.{name}" for name in CLUSTERING_FREE_SPACE),
)
DECISION_WEIGHTS = (
    *(f"association.{name}" for name in ASSOCIATION_DECISIONS),
    *(f"clustering.{name}" for name in CLUSTERING_DECISIONS),
)
REACH_WEIGHT = "clustering.reach"
WEIGHTS = (*(f"association.{name}" for name in ASSOCIATION_WEIGHTS), *(f"clustering.{name}" for name in CLUSTERING_WEIGHTS))
