"""Objective functions: one definition shared by solvers and learning."""
