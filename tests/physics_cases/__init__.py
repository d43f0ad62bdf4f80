"""Missions with a hidden effect, made by a simulator of their own, and the score of what a diagnosis says."""
