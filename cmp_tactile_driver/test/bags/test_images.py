"""Images of folders and frames of videos: in order, of one size, bad ones counted."""

import struct

import cv2
import made_bags
import numpy as np
import pytest
from PIL import Image
from PIL.PngImagePlugin import PngInfo

from cmp_tactile_driver.bags.images import ImageFolder, VideoFile
from cmp_tactile_processing.errors import FrameSourceError


def _read_all(source):
    return [image for _, image in source.images()]


def test_natural_order_and_pixels(image_folder, frames):
    found = _read_all(ImageFolder(image_folder))
    assert all(np.array_equal(a, b) for a, b in zip(found, frames, strict=True))


def test_hidden_files_are_no_images(image_folder, frames):
    """macOS leaves one beside each file on a foreign disk.

    Reports: jurplel/qView 651, CyberTimon/RapidRAW 1570; tried: not read, not counted.
    """
    for number in range(3):
        (image_folder / f"._{number}.png").write_bytes(b"\0\5\x16\7\0\2\0\0Mac OS X")
    source = ImageFolder(image_folder)
    assert len(_read_all(source)) == len(frames)
    assert source.health.bad_frames == 0


def test_colour_stays_colour(tmp_path):
    bgr = np.random.default_rng(1).integers(0, 256, (6, 8, 3), np.uint8)
    cv2.imwrite(str(tmp_path / "a.PNG"), bgr)
    assert np.array_equal(_read_all(ImageFolder(tmp_path)), [bgr])


def test_missing_and_empty_folders(tmp_path):
    with pytest.raises(FrameSourceError, match="nowhere: found no such folder"):
        ImageFolder(tmp_path / "nowhere")
    (tmp_path / "notes.txt").write_text("no image")
    with pytest.raises(FrameSourceError, match=r"found no image among 1 entries, expected \.bmp"):
        ImageFolder(tmp_path)


@pytest.mark.parametrize("keep", [0, 100])
def test_bad_image_in_the_middle_is_skipped_and_named(image_folder, frames, keep):
    path = image_folder / "5.png"
    path.write_bytes(path.read_bytes()[:keep])
    source = ImageFolder(image_folder)
    assert len(_read_all(source)) == len(frames) - 1
    assert source.health.bad_frames == 1
    assert f"{path}: found {keep} bytes that are not a readable image" in source.health.problem


@pytest.mark.parametrize("number", [0, 5])
def test_one_of_another_size_is_skipped_and_named(image_folder, frames, number):
    cv2.imwrite(str(image_folder / f"{number}.png"), np.zeros((10, 20), np.uint8))
    source = ImageFolder(image_folder, expected_size=(64, 48))
    times_s = [n / source.frame_rate for n in range(len(frames)) if n != number]
    assert [time_s for time_s, _ in source.images()] == times_s
    assert f"{number}.png: found 20 x 10 px, expected 64 x 48 px" in source.health.problem


def test_nothing_of_the_expected_size(image_folder):
    source = ImageFolder(image_folder, expected_size=(1024, 768))
    with pytest.raises(
        FrameSourceError,
        match=r"none of the first 2 of 12 images .*found 64 x 48 px, expected 1024 x 768",
    ):
        _read_all(source)


FRAMES = 10
# Motion JPEG of smooth images, in grey levels.
JPEG_TOLERANCE = 6


@pytest.fixture
def video(tmp_path):
    """Ten grey ramps that get brighter, at 25 Hz."""
    return made_bags.write_video(tmp_path / "ramp.avi", "MJPG", _ramps())


def _ramp(number):
    row = np.linspace(0, 100, 64) + 10 * number
    return np.repeat(np.tile(row, (48, 1))[..., None], 3, axis=2).astype(np.uint8)


def _ramps():
    return [_ramp(number) for number in range(FRAMES)]


def test_frames_and_rate(video):
    source = VideoFile(video)
    assert source.frame_rate == 25.0
    for _ in range(2):
        found = _read_all(source)
        assert len(found) == source.declared_frames == FRAMES
        assert source.health.bad_frames == 0
        for number, image in enumerate(found):
            assert np.abs(image.astype(int) - _ramp(number)).max() <= JPEG_TOLERANCE


@pytest.mark.parametrize(
    ("codec", "name", "said"),
    [("mp4v", "a.mp4", "FMP4"), ("MJPG", "a.avi", ""), ("FFV1", "a.mkv", "")],
)
def test_a_codec_that_encodes_changes_is_named(tmp_path, codec, name, said):
    """Small movements are lost; report: facebookresearch/digit360 10 (tactile images as H.264)."""
    assert VideoFile(made_bags.write_video(tmp_path / name, codec, _ramps())).codec == said


def test_missing_and_undecodable_file(tmp_path):
    with pytest.raises(FrameSourceError, match=r"none.avi: found no such file"):
        VideoFile(tmp_path / "none.avi")
    (tmp_path / "bad.avi").write_bytes(b"not a video" * 100)
    with pytest.raises(FrameSourceError, match=r"bad.avi: found 1100 bytes, expected a video"):
        VideoFile(tmp_path / "bad.avi")


def test_truncated_end_is_counted(tmp_path):
    noise = np.random.default_rng(5).integers(0, 256, (FRAMES, 240, 320, 3), np.uint8)
    path = made_bags.write_video(tmp_path / "noise.avi", "MJPG", noise)
    content = path.read_bytes()
    path.write_bytes(content[: len(content) * 6 // 10])
    source = VideoFile(path)
    count = len(_read_all(source))
    assert 0 < count < FRAMES
    assert source.health.bad_frames == FRAMES - count
    assert f"{count} of {FRAMES} frames can be read" in source.health.problem


def _replaced_once(content, old, new):
    assert content.count(old) == 1
    return content.replace(old, new)


def test_frames_of_a_variable_rate_have_their_own_times_and_none_is_missing(tmp_path):
    """Cameras in the dark, telephones and screen recorders write such videos.

    Reports: IntelligentSensingAndRehabilitation/PosePipeline 59, opencv/opencv 15569; tried: times
    were those of a constant rate, and frames that never were counted as damaged.
    """
    path = tmp_path / "slow.mkv"
    content = made_bags.write_video(path, "FFV1", _ramps()).read_bytes()
    for number in reversed(range(6, FRAMES)):
        # In a block of Matroska: track 1, then the time in ms.
        old, new = (struct.pack(">Bh", 0x81, ms) for ms in (40 * number, 100 * number - 360))
        content = _replaced_once(content, old, new)
    last_ms = 100 * (FRAMES - 1) - 360
    duration = struct.pack(">d", 40.0 * FRAMES)
    path.write_bytes(_replaced_once(content, duration, struct.pack(">d", last_ms + 40.0)))
    source = VideoFile(path)
    assert source.declared_frames > FRAMES
    times_s = [time_s for time_s, _ in source.images()]
    expected_s = [0.04 * n for n in range(6)] + [0.1 * n - 0.36 for n in range(6, FRAMES)]
    assert times_s == pytest.approx(expected_s, abs=1e-9)
    assert source.health.bad_frames == 0


def test_a_video_is_not_turned_for_viewing(tmp_path):
    """As photographs are not: the description is that of the camera's own pixels.

    Reports: openmpf/openmpf 1501, opencv/opencv 28644; tried: a video that says it is to be shown
    upside down was read so.
    """
    path = tmp_path / "held_upside_down.mp4"
    content = made_bags.write_video(path, "mp4v", _ramps()).read_bytes()
    before, header, track = content.partition(b"tkhd")
    upright, turned = (
        struct.pack(">9i", s << 16, 0, 0, 0, s << 16, 0, 0, 0, 1 << 30) for s in (1, -1)
    )
    path.write_bytes(before + header + track.replace(upright, turned, 1))
    for number, image in enumerate(_read_all(VideoFile(path))):
        assert np.abs(image.astype(int) - _ramp(number)).max() <= JPEG_TOLERANCE


def test_wrong_size_is_named(video):
    with pytest.raises(FrameSourceError, match="found 64 x 48 px, expected 1024 x 768 px"):
        _read_all(VideoFile(video, expected_size=(1024, 768)))


def test_a_folder_of_16_bits_has_one_scale_from_its_dark_beginning(tmp_path, frames, caplog):
    deep = [
        frame.astype(np.uint16) * (3 if number < 2 else 16) for number, frame in enumerate(frames)
    ]
    for number, frame in enumerate(deep):
        cv2.imwrite(str(tmp_path / f"{number}.png"), frame)
    found = _read_all(ImageFolder(tmp_path))
    for frame, expected in zip(found, deep, strict=True):
        assert np.abs(frame - expected * (255 / 4095)).max() <= 0.51
    assert caplog.text.count("12 of 16 bits") == 1


def test_several_images_in_a_file_are_not_taken_for_one(tmp_path, frames):
    """ImageJ writes recordings so; tried: of 12 frames one was read, and nothing said so.

    Reports: imageio/imageio 449 and 558, cgohlke/tifffile 30.
    """
    path = tmp_path / "stack.tif"
    cv2.imwritemulti(str(path), frames)
    with pytest.raises(FrameSourceError, match=r"stack.tif: found several images in one file"):
        _read_all(ImageFolder(path))
    preview = cv2.resize(frames[0], None, fx=0.25, fy=0.25)
    cv2.imwritemulti(str(path), [frames[0], preview])
    assert np.array_equal(_read_all(ImageFolder(path)), frames[:1])


@pytest.mark.parametrize("orientation", range(1, 9))
@pytest.mark.parametrize(
    ("suffix", "pixels", "options"),
    [
        ("tif", "u1", {}),
        ("tif", "<u2", {}),
        ("tif", ">u2", {}),
        ("tif", "u1", {"big_tiff": True}),
        ("png", "u1", {}),
        ("webp", "u1", {"lossless": True}),
        ("jpg", "u1", {"quality": 100}),
    ],
)
def test_an_image_is_not_turned_for_viewing(
    tmp_path, frames, orientation, suffix, *, pixels, options
):
    """OpenCV turns TIFFs even with its option against it; a mirrored force is silently wrong.

    Reports: opencv/opencv 10703, 14300, 23122; tried: each orientation of 2 to 8 was turned.
    """
    tags = Image.Exif()
    tags[274] = orientation
    path = tmp_path / f"turned.{suffix}"
    Image.fromarray(frames[0].astype(pixels)).save(path, exif=tags, **options)
    (found,) = _read_all(ImageFolder(path))
    grey = found if found.ndim == 2 else found[..., 0]
    np.testing.assert_allclose(grey, frames[0], atol=3 if suffix == "jpg" else 0)


@pytest.mark.parametrize("kind", ["png", "webp"])
def test_an_animation_is_not_taken_for_one_image(tmp_path, frames, kind):
    """Tried: of three frames one was read, and nothing said so.

    Reports: kijai/ComfyUI-KJNodes 341, rokka-io/imagine-vips 35, opencv/opencv 27074.
    """
    path = tmp_path / f"moving.{kind}"
    first, *others = map(Image.fromarray, frames)
    first.save(path, save_all=True, append_images=others, lossless=True)
    with pytest.raises(FrameSourceError, match="found several images in one file"):
        _read_all(ImageFolder(path))
    # A text in the file may hold the name of an animation's chunk.
    words = PngInfo()
    words.add_text("Comment", "made without acTL 1234")
    first.save(path, save_all=True, lossless=True, pnginfo=words)
    assert len(_read_all(ImageFolder(path))) == 1


def test_a_jpeg_with_a_part_missing_is_no_frame(image_folder, frames):
    """huggingface/lerobot 1487: frames half grey were recorded, learned from and never noticed."""
    smooth = cv2.GaussianBlur(frames[0], (0, 0), 2)
    content = cv2.imencode(".jpg", smooth)[1].tobytes()
    middle = len(content) - 300
    (image_folder / "0.jpg").write_bytes(content[:middle] + content[middle + 150 :])
    source = ImageFolder(image_folder)
    assert len(_read_all(source)) == len(frames)
    assert source.health.bad_frames == 1
    assert "0.jpg: found a damaged JPEG" in source.health.problem
