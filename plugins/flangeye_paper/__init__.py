"""Reproduction of the paper's studies: a separate plugin, installed with the extra ``paper``.

It has no solver for real cells.
"""

from collections.abc import Mapping

from flangeye import hookimpl


@hookimpl
def flangeye_stages() -> Mapping[str, str]:
    """Offer the studies' stages."""
    return {
        "acquire.points_as_in_paper": "flangeye_paper.points:acquire_points",
        "acquire.published_centres": "flangeye_paper.published:acquire_published_centres",
        "verify.realisations": "flangeye_paper.realisations:verify_realisations",
        "verify.icp_as_in_paper": "flangeye_paper.icp_as_in_paper:verify_icp_as_in_paper",
        "verify.algorithm_1_by_iteration": "flangeye_paper.icp_as_in_paper:verify_by_iteration",
        "verify.stored_results_as_in_paper": "flangeye_paper.published:verify_stored_results",
        "scan.as_laid": "flangeye_paper.misplanned:scan_as_laid",
        "seam.misplanned": "flangeye_paper.misplanned:seam_misplanned",
    }


@hookimpl
def flangeye_parts() -> Mapping[str, str]:
    """Offer the studies' parts."""
    return {
        "controller.as_printed": "flangeye_paper.as_printed:controller_as_printed",
        "error.oracle_as_in_paper": "flangeye_paper.realisations:error_oracle",
        "error.icp_as_in_paper": "flangeye_paper.icp_as_in_paper:error_icp_as_in_paper",
    }
