"""Reproduction of the tables and figures of chen2020, chen2019 and wang2019, beside this program's results."""
