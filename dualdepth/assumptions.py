"""What the paper leaves open and what this project chose."""

from dualdepth.sections import Loss


def assumptions(loss: Loss) -> list[tuple[str, str, str]]:
    """(topic, choice, why) in the paper's order, with the loss weights of a run."""
    weights = f"photometric {loss.photometric:g}, smoothness {loss.smoothness:g}, features {loss.feature:g}"
    return [(topic, choice.replace("{weights}", weights), why) for topic, choice, why in _ASSUMPTIONS]


_ASSUMPTIONS = (
    ("Decoder", "one rule for all networks, 256 to 16 channels, laterals added", "fitted to the six counts of the paper's overhead table"),
    ("HR-Net", "five stages of two 3x3 convolutions, 32 to 128 channels", "the same counts; the paper's supplement is not public"),
    ("SA-Attention", "1x1 embedding to 128 channels, no softmax", "the formula as printed; other forms are rows of the ablation"),
    ("SA-Attention's start", "weights a tenth as large as usual", "its literal form is cubic in them"),
    (
        "Joining the networks",
        "LR features enlarged three times, bilinearly, added to HR-Net's deepest by concatenation",
        "4x13 to 12x39 is exactly three",
    ),
    ("Disparity", "10 sigmoid + 0.01, depth = 1 / disparity", "Zhou et al., whose lineage this is"),
    ("Normalised depth", "inverse depth divided to mean 10 for each image, gradient flowing", "DDVO's code, which the paper names"),
    (
        "Loss weights",
        "{weights}",
        "smoothness by measurement in the synthetic world, on streets that are scored nowhere",
    ),
    ("Smoothness", "on mean-normalised inverse depth, halved at each coarser scale", "GeoNet; the paper writes D and names DDVO"),
    ("Scales", "each compared at its own size, images shrunk by averaging", "Zhou et al. and GeoNet; the paper says four scales"),
    ("Source views", "minimum over both, no automask", "the paper's formula; an automask is not in it"),
    ("Feature loss", "gradient through both sides", "the literal reading; its spread is logged, since features could shrink to please it"),
    ("Augmentation", "x and y enlarged by 1 to 1.15, one draw a triplet; no flip, no colours", "the paper names scaling and cropping only"),
    (
        "Stage 2",
        "LR-Net frozen, batch norm in evaluation mode; PoseNet goes on from stage 1, on LR images",
        "the odometry table has different poses",
    ),
    (
        "Evaluation",
        "depth is resized, laser-forward ground truth, Garg crop, 80 m, median scaling",
        "SfMLearner's script, of the paper's time",
    ),
    ("Near and far, regions", "one median ratio an image; the row with HR-Net has SA", "the paper is silent on both"),
    (
        "Make3D",
        "central 2:1 band resized to the network's size; the whole photo as a second row",
        "monodepth2's protocol; the paper's words fit both",
    ),
    (
        "Odometry",
        "snippets of 3 frames from one output of PoseNet; the trajectory chains the steps target to next",
        "SfMLearner's convention",
    ),
    ("SA regions", "road = 0, tree & grass = 8 and 9 of the Cityscapes training ids", "the paper used PSPNet and names no ids"),
    ("Sharpness", "raw Sobel taps, reflected border, a sweep of thresholds", "the paper gives neither threshold nor unit"),
    ("Poses of odometry", "ground truth is of camera 0, images of camera 2", "as all others do"),
)
