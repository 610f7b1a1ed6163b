"""Every table and figure of chen2020, chen2019 and wang2019, reproduced and beaten: ``make papers``."""
