"""The score of movers' hypotheses: its terms, and that it is saved with its module."""

import torch

from torchcrf_scan.search.score import FEATURES, PRODUCTS, HypothesisScore


def test_products_are_terms_of_the_score() -> None:
    score = HypothesisScore()
    features = torch.randn(5, len(FEATURES))
    terms = score.terms(features)
    assert terms.shape == (5, 2 * len(FEATURES) + len(PRODUCTS)) == (5, len(score.weight))
    one, other = (FEATURES.index(name) for name in next(iter(PRODUCTS)))
    torch.testing.assert_close(terms[:, 2 * len(FEATURES)], terms[:, one] * terms[:, other])


def test_the_score_is_saved_with_its_module() -> None:
    fitted = HypothesisScore()
    fitted.weight.mul_(2)
    loaded = HypothesisScore()
    loaded.load_state_dict(fitted.state_dict())
    features = torch.randn(3, len(FEATURES))
    torch.testing.assert_close(loaded(features), fitted(features))
    assert ((loaded(features) >= 0) & (loaded(features) <= 1)).all()
