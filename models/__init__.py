"""Denoisers: torch only, no files, no Lightning, no MLflow.

`__all__` is the catalogue: exactly the denoisers, each one a class that keeps the contract of
`models.denoiser.Denoiser`. The contract itself can be imported from here too.
"""

from models.acfm import ACFM
from models.afgsa import AFGSA
from models.classical.bmfr import BMFR
from models.classical.cross_bilateral import CrossBilateral
from models.classical.joint_bilateral import JointBilateral
from models.classical.joint_nlm import JointNLM
from models.classical.nfor import NFOR
from models.classical.nlm import NLM, MultiScaleNLM
from models.classical.rdfc import RDFC
from models.classical.rhf import RHF
from models.classical.svgf import SVGF
from models.classical.wlr import WLR
from models.denoiser import Denoised as Denoised
from models.denoiser import Denoiser as Denoiser
from models.kp import KP
from models.kpcn import KPCN
from models.layers import Layer, Optimized, PixelGather, SampleSplat
from models.lbf import LBF
from models.mrkp import MRKP
from models.nbgd import NBGD
from models.rae import RAE
from models.sbmc import SBMC
from models.wskp import WSKP
from models.wskp_mr import MultiResolutionWSKP

__all__ = [
    "ACFM",
    "AFGSA",
    "BMFR",
    "KP",
    "KPCN",
    "LBF",
    "MRKP",
    "NBGD",
    "NFOR",
    "NLM",
    "RAE",
    "RDFC",
    "RHF",
    "SBMC",
    "SVGF",
    "WLR",
    "WSKP",
    "CrossBilateral",
    "JointBilateral",
    "JointNLM",
    "Layer",
    "MultiResolutionWSKP",
    "MultiScaleNLM",
    "Optimized",
    "PixelGather",
    "SampleSplat",
]
