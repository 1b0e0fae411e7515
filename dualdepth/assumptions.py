"""What the paper leaves open and what this project chose."""

from dualdepth.sections import Loss


def assumptions(loss: Loss) -> list[tuple[str, str, str]]:
    """(topic, choice, why) in the paper's order, with the loss weights of a run."""
    weights = f"photometric {loss.photometric:g}, smoothness {loss.smoothness:g}, features {loss.feature:g}"
    return [(topic, choice.replace("{weights}", weights), why) for topic, choice, why in _ASSUMPTIONS]


_ASSUMPTIONS = (
    ("Decoder", "one rule for all networks, 256 to 16 channels, laterals added", "fitted to the six counts of the paper's overhead table"),
    (
        "Encoders",
        "stride 2 to 32 without classifier, from the library transformers; MobileNetV2 without its last layer to 1280 channels",
        "the paper names them only; its framework's ResNets put their strides elsewhere, and it has no ResNet18",
    ),
    ("HR-Net", "five stages of two 3x3 convolutions, 32 to 128 channels", "the same counts; the paper's supplement is not public"),
    ("Padding", "reflection in all depth networks, zeros in PoseNet", "PoseNet's deepest maps are too small to reflect"),
    (
        "LR image",
        "the HR image averaged 3x3, so that both networks see the same crop",
        "the sizes are exactly a third; the paper says no more",
    ),
    ("SA-Attention", "1x1 embedding to 128 channels, no softmax", "the formula as printed; other forms are rows of the ablation"),
    ("SA-Attention's input", "LR features, colours averaged to their size, coordinates from -1 to 1", "the paper names the three"),
    ("SA-Attention's other similarities", "L1 and L2 distances d as 1 / (1 + d)", "the paper names the distances, not how they weigh"),
    ("SA-Attention's start", "weights a tenth as large as usual", "its literal form is cubic in them"),
    ("Without SA-Attention", "HR-Net is handed LR-Net's deepest features as they are", "the paper says 'w/o SA' and no more"),
    (
        "Joining the networks",
        "LR features enlarged three times, bilinearly, added to HR-Net's deepest by concatenation",
        "4x13 to 12x39 is exactly three",
    ),
    ("Disparity", "10 sigmoid + 0.01, depth = 1 / disparity", "Zhou et al., whose lineage this is"),
    ("Normalised depth", "inverse depth divided to mean 10 for each image, gradient flowing", "DDVO's code, which the paper names"),
    (
        "PoseNet",
        "without batch norm or explainability mask, output times 0.01, target to source, angles about x, y, z",
        "the network of Zhou et al., as the paper says, in their code's conventions",
    ),
    ("Sampling", "pixel centres at whole numbers (align_corners false), the border's value outside", "how frames are resized here, too"),
    (
        "Loss weights",
        "{weights}",
        "smoothness by measurement in the synthetic world, on streets that are scored nowhere",
    ),
    (
        "Means, not sums",
        "each loss is a mean over channels and over the pixels that a source sees in front of its camera and inside its image",
        "the paper writes sums over all pixels, whose weights would depend on the resolution",
    ),
    ("SSIM", "3x3 boxes, mirrored borders, images in [0, 1]", "monodepth2 and GeoNet; the paper gives no window"),
    ("Smoothness", "on mean-normalised inverse depth, halved at each coarser scale", "GeoNet; the paper writes D and names DDVO"),
    ("Scales", "each compared at its own size, images shrunk by averaging", "Zhou et al. and GeoNet; the paper says four scales"),
    ("Source views", "minimum over both, no automask", "the paper's formula; an automask is not in it"),
    ("Feature loss", "gradient through both sides", "the literal reading; its spread is logged, since features could shrink to please it"),
    ("Augmentation", "x and y enlarged by 1 to 1.15, one draw a triplet; no flip, no colours", "the paper names scaling and cropping only"),
    (
        "Training frames",
        "Zhou's triplets of the Eigen split, 39,810, of both colour cameras, as monodepth2 lists them",
        "the paper names the split, not the frames; the list is fixed and free of test drives",
    ),
    (
        "Stage 2",
        "LR-Net frozen, batch norm in evaluation mode; PoseNet goes on from stage 1, on LR images",
        "the odometry table has different poses",
    ),
    (
        "Precision",
        "networks in bf16 where the device computes in it, else float32; geometry and losses in float32",
        "the paper names none; where it exists it is faster by a third, and a CPU that imitates it takes nine times as long",
    ),
    (
        "Weights that are scored",
        "those of the last step; nothing is selected, on test frames least of all",
        "the paper names no validation",
    ),
    (
        "Single networks",
        "a new PoseNet, one stage at high resolution, losses of stage 2",
        "the paper says that they were trained at high resolution, and no more",
    ),
    (
        "Evaluation",
        "depth is resized, laser-forward ground truth, Garg crop, 80 m, median scaling",
        "SfMLearner's script, of the paper's time",
    ),
    (
        "Frames that are scored",
        "resized once to the HR size, predicted once, not flipped",
        "as in training; the paper names no post-processing",
    ),
    (
        "Train set mean",
        "mean depth of up to 400 training-side laser frames on a grid of 47x156 cells",
        "the paper gives the row, not how it was fitted",
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
    ("Overhead", "multiply-accumulates, LR-Net's decoder counted", "the reading that comes nearest to the paper's row of the dual network"),
    ("Poses of odometry", "ground truth is of camera 0, images of camera 2", "as all others do"),
    ("Odometry's training frames", "the left colour camera, frames where the car stands included", "the paper names the sequences only"),
)
