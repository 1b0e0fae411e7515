"""Download KITTI, as much of it as is needed, from its public home.

    --root KITTI --profile sample                    the three drives of the profile `sample` (2 GB)
    --root KITTI --profile paper --cameras image_02 image_03
                                                     all that the paper's split needs (some 170 GB), colour cameras only
    --root KITTI 2011_09_26/2011_09_26_drive_0095_sync
                                                     one drive, with the calibration of its day
    --root KITTI --odometry                          colour images (65 GB), calibration and poses, in KITTI/odometry
    --root KITTI --improved-depth                    accumulated depth maps (14 GB), in KITTI/depth_annotated
    --root KITTI --lists-only                        the field's lists of frames (2 MB), in KITTI/lists

Stop it at any time: the same command goes on from there, verifies all it gets, and does nothing for what is there already.
Whoever has KITTI needs none of this: give that folder as KITTI_ROOT. The data are for non-commercial use (CC BY-NC-SA 3.0), see cvlibs.net.
"""

import argparse
from collections.abc import Sequence
from pathlib import Path

from data_scripts import sources
from data_scripts.download import download
from dualdepth.errors import InputError, exit_on_input_error
from dualdepth.files import check_writable
from dualdepth.profile import load_profile


def main(argv: Sequence[str] | None = None, *, kitti_home: str = sources.KITTI_HOME, lists_home: str = sources.LISTS_HOME) -> None:
    """Run the command line; bad input, a failed download or a full disk is one line on stderr and exit code 2. Other homes: for tests."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    add = parser.add_argument
    add("drives", nargs="*", metavar="DRIVE", help="raw drives like 2011_09_26/2011_09_26_drive_0095_sync")
    add("--root", required=True, type=Path, metavar="DIR", help="folder to fill, then given as KITTI_ROOT")
    add("--profile", metavar="NAME", help="the raw drives and lists that a profile needs: sample, paper, or a .yaml file")
    add("--odometry", action="store_true", help="the odometry sequences: colour images, calibration, poses (65 GB)")
    add("--improved-depth", action="store_true", help="the improved ground truth, data_depth_annotated (14 GB)")
    add("--lists-only", action="store_true", help="the field's lists of frames and nothing else")
    wanted = "unpack only these, such as image_02 image_03"
    add("--cameras", nargs="+", choices=sources.CAMERAS, default=sources.CAMERAS, metavar="CAMERA", help=wanted)
    add("--keep-archives", action="store_true", help="keep the zip files, in DIR/archives; else each goes once unpacked")
    with exit_on_input_error():
        given = parser.parse_args(argv)
        if not (given.drives or given.profile or given.odometry or given.improved_depth or given.lists_only):
            parser.error("nothing to download: name drives, or give --profile, --odometry, --improved-depth or --lists-only")
        root, lists, drives = given.root, given.root / "lists", list(given.drives)
        sources.drive_archives(drives)  # a misspelt name is told before anything is fetched
        data = load_profile(given.profile).data if given.profile else None
        if data and data.source != "kitti":
            raise InputError(f"profile {given.profile} makes its own data: there is nothing to download; choose sample or paper")
        check_writable(root)
        if data or given.lists_only:
            for name in sources.LISTS:
                sources.named_list(name, lists, lists_home)
            print(f"{len(sources.LISTS)} lists in {lists}")
        if given.lists_only:
            return
        if data:
            drives += sources.profile_drives(data, sources.profile_lists(data, lists, lists_home))
        archives = sources.drive_archives(drives) + list(sources.ODOMETRY) * given.odometry
        archives += [sources.IMPROVED_DEPTH] * given.improved_depth
        fetched = download(archives, root, kitti_home, cameras=given.cameras, keep_archives=given.keep_archives)
        print(f"{len(archives)} archives unpacked, {fetched} of them now")
        homes = {f"KITTI_ROOT={root}": drives, f"ODOMETRY_ROOT={root / 'odometry'}": given.odometry}
        homes |= {f"improved ground truth: {root / 'depth_annotated'}": given.improved_depth}
        print("\n".join(home for home, there in homes.items() if there))


if __name__ == "__main__":
    main()
