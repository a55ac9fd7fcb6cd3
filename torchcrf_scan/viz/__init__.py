"""Figures of pairs, predictions and confidences."""
