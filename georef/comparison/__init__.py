"""The tables of an evaluation: variants of one project, run up to localization and compared with the truth."""
