"""Algorithm 1 as printed: node by node, the motions re-estimated after every visit (spec 7.2, `flooding`).

Slow and faithful. Visits run x_c_1..x_c_N, x_a_1..x_a_N, ascending or in alternating direction (A-20); each visit rebuilds the
node's local features from the present motions and plug-ins, sends its messages, updates its label and the running sums of
its clusters. The association candidates are chosen anew before every iteration and messages carried over by target point.
Labels taken during the visits serve ComputeRT alone; those of the answer are Eq. 3's, from all messages (lines 16 to 21).
"""

from __future__ import annotations

from dataclasses import dataclass, replace

import torch
from torch import Tensor

from torchcrf_scan.config import InferenceConfig, ModelConfig
from torchcrf_scan.features import clustering
from torchcrf_scan.features.association import pairwise_features
from torchcrf_scan.features.candidates import Candidates
from torchcrf_scan.features.potentials import (
    AssociationStates,
    PairView,
    association_unary,
    clustering_potentials,
    clustering_unary,
    find_candidates,
    possible_clusters,
    registered_points,
    state_mask,
)
from torchcrf_scan.features.shape import gather_points
from torchcrf_scan.inference import joint
from torchcrf_scan.inference.messages import normalise, normalise_beliefs, reduce_states
from torchcrf_scan.inference.motion import RunningSums, retire_empty
from torchcrf_scan.inference.start import Start
from torchcrf_scan.inference.state import Parameters, State
from torchcrf_scan.names import ASSOCIATION_UNARY
from torchcrf_scan.prediction import Prediction

MESSAGE_TOLERANCE = 1e-3


@dataclass(slots=True)
class Messages:
    """Messages into every node of a chain: from the node before it and from the node after it, (B, N, S) each."""

    forward: Tensor
    backward: Tensor

    @classmethod
    def zeros(cls, B: int, N: int, S: int, like: Tensor) -> Messages:
        """Initial messages, all 0."""
        return cls(like.new_zeros(B, N, S), like.new_zeros(B, N, S))

    def copy(self) -> Messages:
        """The same messages, unchanged by later ones."""
        return Messages(self.forward.clone(), self.backward.clone())

    def keep(self, before: Messages, settled: Tensor) -> None:
        """Takes back the messages sent since `before` in the pairs that have converged (B,)."""
        self.forward = torch.where(settled[:, None, None], before.forward, self.forward)
        self.backward = torch.where(settled[:, None, None], before.backward, self.backward)

    def agree_with(self, before: Messages) -> Tensor:
        """(B,) whether no message has changed by more than the tolerance (spec 7.6)."""
        both = ((self.forward, before.forward), (self.backward, before.backward))
        steady = [((new == old) | ((new - old).abs() < MESSAGE_TOLERANCE)).flatten(1).all(-1) for new, old in both]
        return torch.stack(steady).all(0)

    def joined(self, unary: Tensor) -> Tensor:
        """(B, N, S) beliefs of all nodes (Eq. 3): local potential and all incoming messages."""
        return unary + self.forward + self.backward


@torch.no_grad()
def decode(view: PairView, start: Start, parameters: Parameters, model: ModelConfig) -> Prediction:
    """Labels and motions of a batch; no gradient. Arguments as in `joint.decode`."""
    run = Flooding(view, start, parameters, model)
    converged = torch.zeros(len(view.batch), dtype=torch.bool, device=view.batch.source.device)
    iterations = torch.zeros(len(view.batch), dtype=torch.int64, device=view.batch.source.device)
    stop_early = model.inference.stop_early
    for iteration in range(model.inference.iterations):
        before, sent = run.state, [messages.copy() for messages in run.messages]
        run.iterate(descending=model.inference.flooding_order == "alternate" and iteration % 2 == 1)
        if stop_early:
            run.state = joint.keep_settled(run.state, before, converged)
            for messages, old in zip(run.messages, sent, strict=True):
                messages.keep(old, converged)
        iterations = iterations + (~converged | (not stop_early)).long()
        agree = [messages.agree_with(old) for messages, old in zip(run.messages, sent, strict=True)]
        converged = converged | (joint.has_settled(run.state, before, model.inference) & torch.stack(agree).all(0))
        if stop_early and bool(converged.all()):
            break
    run.take_labels()
    merged = joint.merge_alike(view, run.state, parameters.scales.cluster_distance)
    return joint.read_out(view.batch, start, merged, parameters, model.inference, converged, iterations)


class Flooding:
    """Working state of one run: labels and motions, messages of both chains, running sums of every cluster."""

    def __init__(self, view: PairView, start: Start, parameters: Parameters, model: ModelConfig) -> None:
        self.view, self.start, self.parameters, self.model = view, start, parameters, model
        self.state = joint.first_state(view, start, model.inference)
        B, N = view.batch.source.shape[:2]
        self.cluster_messages = Messages.zeros(B, N, self.state.log_cluster.shape[-1], view.batch.source)
        self.association_messages = Messages.zeros(B, N, self.state.log_association.shape[-1], view.batch.source)

    @property
    def config(self) -> InferenceConfig:
        """The settings of inference."""
        return self.model.inference

    def iterate(self, descending: bool) -> None:
        """One visit to every node of every chain of the model."""
        batch = self.view.batch
        self.sums = self._running_sums()
        found = find_candidates(self.view, self.state.motions.value, self.state.motions.active, self.config)
        order = range(batch.source.shape[1] - 1, -1, -1) if descending else range(batch.source.shape[1])
        if self.model.has_clusters:
            for i in order:
                self.visit_cluster(i, found)
        if self.model.has_association:
            self._take_candidates(found)
            for i in order:
                self.visit_association(i)
        self._retire_empty()

    @property
    def messages(self) -> tuple[Messages, Messages]:
        """Messages of both chains."""
        return self.cluster_messages, self.association_messages

    def take_labels(self) -> None:
        """Labels every node by its belief (lines 16 to 21): features anew at the last motions, all messages, argmax (Eq. 3).

        The last visit has computed the motions already (line 16).
        """
        mask, everything = self.view.batch.source_mask, slice(0, self.view.batch.source.shape[1])
        found = find_candidates(self.view, self.state.motions.value, self.state.motions.active, self.config)
        if self.model.has_clusters:
            belief = self.cluster_messages.joined(self._cluster_potentials(everything, found)[0])
            labels = joint.cluster_labels(belief.argmax(-1), belief.shape[-1] - 1, mask)
            self.state = replace(self.state, log_cluster=normalise_beliefs(belief, self.config.temperature), cluster=labels)
        if self.model.has_association:
            self._take_candidates(found)
            belief = self.association_messages.joined(self._association_unary(everything))
            labels = joint.association_labels(belief.argmax(-1), found.index, mask)
            self.state = replace(self.state, log_association=normalise_beliefs(belief, self.config.temperature), association=labels)
            if not self.model.has_clusters:
                self.state = joint.inliers_are_background(self.state)

    def visit_cluster(self, i: int, found: Candidates) -> None:
        """Visits one node of the clustering chain: local features, messages to both neighbours, label, motions."""
        batch, state = self.view.batch, self.state
        here = slice(i, i + 1)
        around = slice(max(i - 1, 0), min(i + 2, batch.source.shape[1]))
        unary, edges = self._cluster_potentials(around, found)
        k = i - around.start
        before = edges[:, k - 1] if k > 0 else None
        after = edges[:, k] if k < edges.shape[1] else None
        belief = self._send(self.cluster_messages, i, unary[:, k], before, after)
        log_cluster = state.log_cluster.clone()
        log_cluster[:, here] = normalise_beliefs(belief, self.config.temperature)[:, None]
        cluster = state.cluster.clone()
        cluster[:, here] = joint.cluster_labels(belief[:, None].argmax(-1), belief.shape[-1] - 1, batch.source_mask[:, here])
        self._relabel(i, replace(state, log_cluster=log_cluster, cluster=cluster))

    def visit_association(self, i: int) -> None:
        """Visits one node of the association chain, likewise."""
        batch, state = self.view.batch, self.state
        here = slice(i, i + 1)
        candidates, unary = self.states.nodes(here).candidates, self._association_unary(here)[:, 0]
        before = self.edges[:, i - 1] if i > 0 else None
        after = self.edges[:, i] if i < self.edges.shape[1] else None
        belief = self._send(self.association_messages, i, unary, before, after)
        log_association = state.log_association.clone()
        log_association[:, here] = normalise_beliefs(belief, self.config.temperature)[:, None]
        association = state.association.clone()
        association[:, here] = joint.association_labels(belief[:, None].argmax(-1), candidates, batch.source_mask[:, here])
        state = replace(state, log_association=log_association, association=association)
        if not self.model.has_clusters:
            state = joint.inliers_are_background(state)
        self._relabel(i, state)

    def _cluster_potentials(self, nodes: slice, found: Candidates) -> tuple[Tensor, Tensor]:
        """Log potentials of some nodes of the clustering chain and of the edges between them, at the present motions."""
        batch, state, scales = self.view.batch, self.state, self.parameters.scales
        source, motions, active = batch.source[:, nodes], state.motions.value, state.motions.active
        at = clustering.correspond(source, batch.target, motions, found.nearest[:, nodes], state.association[:, nodes])
        reach = None if self.start.reach is None else self.start.reach[:, nodes]
        local = clustering_unary(self.view, at, motions, active, scales, reach)
        possible = possible_clusters(active, self.view.within(reach), source.shape[1])
        return clustering_potentials(local, clustering.pairwise_features(source, at, scales), possible, self.parameters.clustering)

    def _association_unary(self, nodes: slice) -> Tensor:
        """Log potentials of some nodes of the association chain, at the present motions and clusters."""
        state, scales, boosters = self.state, self.parameters.scales, self.parameters.boosters
        source, motions = self.view.batch.source[:, nodes], state.motions
        moved = registered_points(source, motions.value, motions.active, state.log_cluster[:, nodes])
        states = self.states.nodes(nodes)
        features = association_unary(self.view, states, moved, scales, boosters)
        return (features @ self.parameters.association[:ASSOCIATION_UNARY]).masked_fill(~state_mask(states.mask), -torch.inf)

    def _send(self, messages: Messages, i: int, unary: Tensor, before: Tensor | None, after: Tensor | None) -> Tensor:
        """Sends node i's messages to its neighbours; padding sends none. Returns its belief (B, S)."""
        mask = self.view.batch.source_mask
        temperature = self.config.temperature
        if after is not None:
            said = normalise(reduce_states((unary + messages.forward[:, i])[:, :, None] + after, 1, temperature))
            messages.forward[:, i + 1] = said.masked_fill(~mask[:, i, None], 0.0)
        if before is not None:
            said = normalise(reduce_states((unary + messages.backward[:, i])[:, None] + before, 2, temperature))
            messages.backward[:, i - 1] = said.masked_fill(~mask[:, i, None], 0.0)
        return unary + messages.forward[:, i] + messages.backward[:, i]

    def _relabel(self, i: int, state: State) -> None:
        """ComputeRT after node i changed its label or partner, in O(1) (spec 7.4)."""
        target, C = self.view.batch.target, state.motions.value.shape[1]

        def vote(of: State) -> tuple[Tensor, Tensor]:
            speaks = (of.association[:, i] >= 0) & (of.cluster[:, i] >= 0)
            one_hot = torch.nn.functional.one_hot(of.cluster[:, i].clamp(min=0), C).double() * speaks[:, None]
            return gather_points(target, of.association[:, i : i + 1].clamp(min=0))[:, 0], one_hot

        self.sums.change(self.view.batch.source[:, i], *vote(self.state), *vote(state))
        value = self.sums.motions(state.motions, self.config.min_extent)
        self.state = replace(state, motions=replace(state.motions, value=value))

    def _running_sums(self) -> RunningSums:
        batch, state = self.view.batch, self.state
        clusters = torch.arange(state.motions.value.shape[1], device=state.cluster.device)
        weights = (state.cluster[:, None] == clusters[:, None]) & (state.association >= 0)[:, None]
        return RunningSums.of(batch.source, gather_points(batch.target, state.association.clamp(min=0)), weights)

    def _take_candidates(self, found: Candidates) -> None:
        """Sets new inlier states of every node; messages follow their target points, a new state takes the smallest entry."""
        batch, scales = self.view.batch, self.parameters.scales
        old, old_mask = self.state.candidates, self.state.candidate_mask
        same = (found.index[..., :, None] == old[..., None, :]) & old_mask[..., None, :]  # (B, N, K new, K old)
        for name in ("forward", "backward"):
            message = getattr(self.association_messages, name)
            inliers = message[..., :-1]
            carried = torch.where(same, inliers[..., None, :], -torch.inf).amax(-1)
            least = inliers.masked_fill(~old_mask, torch.inf).amin(-1, keepdim=True)
            least = torch.where(least < torch.inf, least, 0.0)
            carried = torch.where(same.any(-1), carried, least)
            setattr(self.association_messages, name, torch.cat([carried, message[..., -1:]], dim=-1))
        self.states = AssociationStates.of(self.view, found.index, found.mask, scales, self.parameters.boosters)
        pairwise = pairwise_features(batch.source, batch.target, found.index, scales, has_lengths=self.view.has_lengths)
        self.edges = pairwise @ self.parameters.association[ASSOCIATION_UNARY:]
        self.state = replace(self.state, candidates=found.index, candidate_mask=found.mask)

    def _retire_empty(self) -> None:
        """Removes clusters without a point for two iterations (spec 7.5)."""
        self.state = replace(self.state, motions=retire_empty(self.state.motions, self.sums.value[..., 0].round()))
