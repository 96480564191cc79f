"""Message definitions of the types a log holds, in the ``ros2msg`` form (each dependency after a rule of 80 ``=``)."""

from __future__ import annotations

__all__ = ["SCHEMAS", "schema_text"]

_TIME = ("builtin_interfaces/Time", "int32 sec\nuint32 nanosec\n")
_HEADER = ("std_msgs/Header", "builtin_interfaces/Time stamp\nstring frame_id\n")
_POINT = ("geometry_msgs/Point", "float64 x\nfloat64 y\nfloat64 z\n")
_VECTOR3 = ("geometry_msgs/Vector3", "float64 x\nfloat64 y\nfloat64 z\n")
_QUATERNION = ("geometry_msgs/Quaternion", "float64 x 0\nfloat64 y 0\nfloat64 z 0\nfloat64 w 1\n")
_POSE = ("geometry_msgs/Pose", "Point position\nQuaternion orientation\n")
_TWIST = ("geometry_msgs/Twist", "Vector3 linear\nVector3 angular\n")
_FIELD = (
    "sensor_msgs/PointField",
    "uint8 INT8=1\nuint8 UINT8=2\nuint8 INT16=3\nuint8 UINT16=4\nuint8 INT32=5\nuint8 UINT32=6\nuint8 FLOAT32=7\n"
    "uint8 FLOAT64=8\nstring name\nuint32 offset\nuint8 datatype\nuint32 count\n",
)
_TRANSFORM = ("geometry_msgs/Transform", "Vector3 translation\nQuaternion rotation\n")
_STAMPED = ("geometry_msgs/TransformStamped", "std_msgs/Header header\nstring child_frame_id\nTransform transform\n")
_POSE_COV = ("geometry_msgs/PoseWithCovariance", "Pose pose\nfloat64[36] covariance\n")
_TWIST_COV = ("geometry_msgs/TwistWithCovariance", "Twist twist\nfloat64[36] covariance\n")
_KEY_VALUE = ("diagnostic_msgs/KeyValue", "string key\nstring value\n")
_DIAGNOSTIC = (
    "diagnostic_msgs/DiagnosticStatus",
    "byte OK=0\nbyte WARN=1\nbyte ERROR=2\nbyte STALE=3\nbyte level\nstring name\nstring message\n"
    "string hardware_id\nKeyValue[] values\n",
)

SCHEMAS: dict[str, tuple[str, tuple[tuple[str, str], ...]]] = {
    "sensor_msgs/msg/PointCloud2": (
        "std_msgs/Header header\nuint32 height\nuint32 width\nPointField[] fields\nbool is_bigendian\n"
        "uint32 point_step\nuint32 row_step\nuint8[] data\nbool is_dense\n",
        (_HEADER, _TIME, _FIELD),
    ),
    "geometry_msgs/msg/PoseStamped": (
        "std_msgs/Header header\nPose pose\n",
        (_HEADER, _TIME, _POSE, _POINT, _QUATERNION),
    ),
    "nav_msgs/msg/Odometry": (
        "std_msgs/Header header\nstring child_frame_id\ngeometry_msgs/PoseWithCovariance pose\n"
        "geometry_msgs/TwistWithCovariance twist\n",
        (_HEADER, _TIME, _POSE_COV, _POSE, _POINT, _QUATERNION, _TWIST_COV, _TWIST, _VECTOR3),
    ),
    "tf2_msgs/msg/TFMessage": (
        "geometry_msgs/TransformStamped[] transforms\n",
        (_STAMPED, _HEADER, _TIME, _TRANSFORM, _VECTOR3, _QUATERNION),
    ),
    "diagnostic_msgs/msg/DiagnosticArray": (
        "std_msgs/Header header\nDiagnosticStatus[] status\n",
        (_HEADER, _TIME, _DIAGNOSTIC, _KEY_VALUE),
    ),
}


def schema_text(name: str) -> bytes:
    """The full definition of a message type of ``SCHEMAS``."""
    body, dependencies = SCHEMAS[name]
    parts = [body, *(f"MSG: {dep}\n{text}" for dep, text in dependencies)]
    return ("\n" + "=" * 80 + "\n").join(p.rstrip("\n") for p in parts).encode() + b"\n"
