"""Images survive the way through a message; colours, depths and wrong sizes are as in cv_bridge."""

import numpy as np
import pytest

pytest.importorskip("sensor_msgs", reason="ROS 2 is not there")

from cv_bridge import CvBridge, CvBridgeError
from sensor_msgs.msg import Image
from std_msgs.msg import Header

pytestmark = pytest.mark.ros

BRIDGE = CvBridge()
HEIGHT, WIDTH = 5, 6
# ITU-R BT.601 weights in fixed point: OpenCV's grey differs by a rounding from the exact sum.
ATOL_GREY = 1


def random_image(dtype, channels, seed=0):
    shape = (HEIGHT, WIDTH) if channels == 1 else (HEIGHT, WIDTH, channels)
    generator = np.random.default_rng(seed)
    if np.dtype(dtype).kind == "f":
        return generator.normal(size=shape).astype(dtype)
    limits = np.iinfo(dtype)
    return generator.integers(limits.min, limits.max, shape, dtype, endpoint=True)


def message_of(image, encoding, padding=0, bigendian=False):
    """A message as a camera writes it, its rows padded with a value that must not be seen."""
    order = ">" if bigendian else "<"
    rows = np.ascontiguousarray(image).astype(image.dtype.newbyteorder(order))
    rows = rows.reshape(image.shape[0], -1).view(np.uint8)
    rows = np.pad(rows, ((0, 0), (0, padding)), constant_values=0xEE)
    message = Image(height=image.shape[0], width=image.shape[1], encoding=encoding)
    message.step = rows.shape[1]
    message.is_bigendian = bigendian
    message.data.frombytes(rows.tobytes())
    return message


@pytest.mark.parametrize(
    ("encoding", "dtype", "channels"),
    [
        ("mono8", np.uint8, 1),
        ("mono16", np.uint16, 1),
        ("bgr8", np.uint8, 3),
        ("rgb8", np.uint8, 3),
        ("bgra8", np.uint8, 4),
        ("rgba8", np.uint8, 4),
        ("yuv422", np.uint8, 2),
        ("yuv422_yuy2", np.uint8, 2),
        ("8UC1", np.uint8, 1),
        ("8UC3", np.uint8, 3),
        ("16UC1", np.uint16, 1),
        ("32FC1", np.float32, 1),
        ("64FC2", np.float64, 2),
        ("16S", np.int16, 1),
    ],
)
def test_there_and_back(encoding, dtype, channels):
    image = random_image(dtype, channels)
    message = BRIDGE.cv2_to_imgmsg(image, encoding)
    assert message.encoding == encoding
    assert (message.height, message.width) == (HEIGHT, WIDTH)
    assert message.step == WIDTH * channels * image.itemsize
    returned = BRIDGE.imgmsg_to_cv2(message)
    assert returned.dtype == image.dtype
    np.testing.assert_array_equal(returned, image)


def test_passthrough_names_the_type():
    message = BRIDGE.cv2_to_imgmsg(random_image(np.uint8, 3))
    assert message.encoding == "8UC3"


def test_the_header_is_handed_on():
    header = Header(frame_id="finger")
    header.stamp.sec = 7
    message = BRIDGE.cv2_to_imgmsg(random_image(np.uint8, 1), "mono8", header)
    assert message.header == header


def test_a_view_that_is_not_contiguous():
    whole = random_image(np.uint8, 3)
    message = BRIDGE.cv2_to_imgmsg(whole[::2, 1:5, ::-1], "rgb8")
    np.testing.assert_array_equal(BRIDGE.imgmsg_to_cv2(message), whole[::2, 1:5, ::-1])


@pytest.mark.parametrize(("dtype", "channels"), [(np.uint8, 1), (np.uint8, 3), (np.uint16, 1)])
@pytest.mark.parametrize("padding", [1, 2, 64])
def test_padded_rows(dtype, channels, padding):
    """Cameras align rows; an odd padding is no whole number of pixels."""
    image = random_image(dtype, channels)
    encoding = BRIDGE.cv2_to_imgmsg(image).encoding
    returned = BRIDGE.imgmsg_to_cv2(message_of(image, encoding, padding))
    np.testing.assert_array_equal(returned, image)


@pytest.mark.parametrize("dtype", [np.uint16, np.float32])
def test_big_endian(dtype):
    image = random_image(dtype, 1)
    encoding = BRIDGE.cv2_to_imgmsg(image).encoding
    returned = BRIDGE.imgmsg_to_cv2(message_of(image, encoding, padding=4, bigendian=True))
    assert returned.dtype.isnative
    np.testing.assert_array_equal(returned, image)


def test_a_big_endian_array_says_so_in_its_message():
    image = random_image(np.uint16, 1)
    message = BRIDGE.cv2_to_imgmsg(image.astype(">u2"), "mono16")
    assert message.is_bigendian
    np.testing.assert_array_equal(BRIDGE.imgmsg_to_cv2(message), image)


def test_swapped_colours():
    image = random_image(np.uint8, 3)
    message = BRIDGE.cv2_to_imgmsg(image, "bgr8")
    np.testing.assert_array_equal(BRIDGE.imgmsg_to_cv2(message, "rgb8"), image[..., ::-1])
    with_alpha = BRIDGE.imgmsg_to_cv2(message, "rgba8")
    np.testing.assert_array_equal(with_alpha[..., :3], image[..., ::-1])
    assert (with_alpha[..., 3] == 255).all()


@pytest.mark.parametrize(("encoding", "weights"), [("rgb8", (0, 1, 2)), ("bgr8", (2, 1, 0))])
def test_grey_is_weighted_by_colour(encoding, weights):
    image = random_image(np.uint8, 3)
    grey = BRIDGE.imgmsg_to_cv2(BRIDGE.cv2_to_imgmsg(image, encoding), "mono8")
    expected = image[..., weights] @ np.array([0.299, 0.587, 0.114])
    np.testing.assert_allclose(grey, expected, atol=ATOL_GREY)


@pytest.mark.parametrize(("encoding", "luma"), [("yuv422_yuy2", 0), ("yuv422", 1)])
def test_the_grey_of_yuv_is_its_luma(encoding, luma):
    image = random_image(np.uint8, 2)
    grey = BRIDGE.imgmsg_to_cv2(BRIDGE.cv2_to_imgmsg(image, encoding), "mono8")
    np.testing.assert_array_equal(grey, image[..., luma])


def test_neutral_yuv_becomes_grey_bgr():
    image = np.full((HEIGHT, WIDTH, 2), 128, np.uint8)
    bgr = BRIDGE.imgmsg_to_cv2(BRIDGE.cv2_to_imgmsg(image, "yuv422_yuy2"), "bgr8")
    assert bgr.shape == (HEIGHT, WIDTH, 3)
    # Studio range: luma 128 of 16..235 is 130.4 of 0..255.
    np.testing.assert_allclose(bgr, (128 - 16) * 255 / 219, atol=1)


def test_16_bit_is_scaled_to_8_and_back():
    image = np.array([[0, 128, 257, 32896, 65535]], np.uint16)
    grey = BRIDGE.imgmsg_to_cv2(BRIDGE.cv2_to_imgmsg(image, "mono16"), "mono8")
    np.testing.assert_array_equal(grey, [[0, 0, 1, 128, 255]])
    back = BRIDGE.imgmsg_to_cv2(BRIDGE.cv2_to_imgmsg(grey, "mono8"), "mono16")
    np.testing.assert_array_equal(back, [[0, 0, 257, 32896, 65535]])


def test_floats_are_rounded_and_saturated():
    image = np.array([[-1.0, 0.4, 0.6, 254.6, 300.0]], np.float32)
    message = BRIDGE.cv2_to_imgmsg(image, "32FC1")
    np.testing.assert_array_equal(
        BRIDGE.imgmsg_to_cv2(message, "8UC1"), [[0, 0, 1, 255, 255]], strict=False
    )


def test_the_same_encoding_is_a_copy():
    message = BRIDGE.cv2_to_imgmsg(random_image(np.uint8, 1), "mono8")
    image = BRIDGE.imgmsg_to_cv2(message, "mono8")
    before = message.data[0]
    image[0, 0] = before ^ 0xFF
    assert message.data[0] == before


@pytest.mark.parametrize(
    ("field", "value", "expected"),
    [
        ("step", 5, "found step 5, expected at least 6"),
        ("step", 7, "found 30 bytes of data, expected 35"),
        ("height", 6, "found 30 bytes of data, expected 36"),
        ("width", 7, "found step 6, expected at least 7"),
        ("height", 4_000_000_000, "found 30 bytes of data, expected 24000000000"),
        ("encoding", "bgr8", "found step 6, expected at least 18"),
        ("encoding", "jpeg", "found 'jpeg', expected one of mono8"),
        ("encoding", "", "found '', expected one of mono8"),
        ("encoding", "8UC0", "found '8UC0', expected one of"),
    ],
)
def test_a_message_that_contradicts_itself(field, value, expected):
    message = BRIDGE.cv2_to_imgmsg(random_image(np.uint8, 1), "mono8")
    setattr(message, field, value)
    with pytest.raises(CvBridgeError, match=expected):
        BRIDGE.imgmsg_to_cv2(message)


def test_an_empty_message():
    with pytest.raises(CvBridgeError, match="found 0 x 0 pixels"):
        BRIDGE.imgmsg_to_cv2(Image(encoding="mono8"))


@pytest.mark.parametrize(
    ("source", "channels", "target"),
    [("8UC1", 1, "mono8"), ("8UC3", 3, "bgr8"), ("bgr8", 3, "8UC1"), ("mono8", 1, "yuv422")],
)
def test_conversions_that_do_not_exist(source, channels, target):
    message = BRIDGE.cv2_to_imgmsg(random_image(np.uint8, channels), source)
    with pytest.raises(CvBridgeError, match=f"{source!r} to {target!r}"):
        BRIDGE.imgmsg_to_cv2(message, target)


def test_a_yuv_image_of_odd_width():
    """Two neighbouring pixels share their colour."""
    message = BRIDGE.cv2_to_imgmsg(random_image(np.uint8, 2)[:, :5], "yuv422_yuy2")
    with pytest.raises(CvBridgeError, match="'yuv422_yuy2' to 'bgr8'"):
        BRIDGE.imgmsg_to_cv2(message, "bgr8")


@pytest.mark.parametrize(
    ("image", "encoding", "expected"),
    [
        (np.zeros((2, 2), np.uint16), "mono8", "found 16UC1, expected 8UC1"),
        (np.zeros((2, 2, 4), np.uint8), "bgr8", "found 8UC4, expected 8UC3"),
        (np.zeros((2, 2), np.complex128), "passthrough", "of complex128, expected"),
        (np.zeros((2, 2), np.bool_), "passthrough", "of bool, expected"),
        (np.zeros(4, np.uint8), "passthrough", r"found shape \(4,\)"),
    ],
)
def test_arrays_that_do_not_fit(image, encoding, expected):
    with pytest.raises(CvBridgeError, match=expected):
        BRIDGE.cv2_to_imgmsg(image, encoding)


def test_no_array_at_all():
    with pytest.raises(TypeError, match="found list, expected a numpy array"):
        BRIDGE.cv2_to_imgmsg([[0]])
