"""Definitions of the ROS 2 messages that logs and results contain, in the form of their ``.msg`` files.

They are part of a log, so that a program can decode its messages without an installation of ROS.
"""

from __future__ import annotations

_TIME = ("builtin_interfaces/Time", "int32 sec\nuint32 nanosec\n")
_HEADER = ("std_msgs/Header", "builtin_interfaces/Time stamp\nstring frame_id\n")
_DURATION = ("builtin_interfaces/Duration", "int32 sec\nuint32 nanosec\n")
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
_COLOUR = ("std_msgs/ColorRGBA", "float32 r\nfloat32 g\nfloat32 b\nfloat32 a\n")
_IMAGE = ("sensor_msgs/CompressedImage", "std_msgs/Header header\nstring format\nuint8[] data\n")
_UV = ("visualization_msgs/UVCoordinate", "float32 u\nfloat32 v\n")
_MESH_FILE = ("visualization_msgs/MeshFile", "string filename\nuint8[] data\n")
_POSE_STAMPED = ("geometry_msgs/PoseStamped", "std_msgs/Header header\nPose pose\n")

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
    "geometry_msgs/msg/PoseWithCovarianceStamped": (
        "std_msgs/Header header\nPoseWithCovariance pose\n",
        (_HEADER, _TIME, _POSE_COV, _POSE, _POINT, _QUATERNION),
    ),
    "nav_msgs/msg/Path": (
        "std_msgs/Header header\ngeometry_msgs/PoseStamped[] poses\n",
        (_HEADER, _TIME, _POSE_STAMPED, _POSE, _POINT, _QUATERNION),
    ),
    "rcl_interfaces/msg/Log": (
        "byte DEBUG=10\nbyte INFO=20\nbyte WARN=30\nbyte ERROR=40\nbyte FATAL=50\n"
        "builtin_interfaces/Time stamp\nuint8 level\nstring name\nstring msg\nstring file\nstring function\n"
        "uint32 line\n",
        (_TIME,),
    ),
    "std_msgs/msg/Float64": ("float64 data\n", ()),
    "visualization_msgs/msg/Marker": (
        "int32 ARROW=0\nint32 CUBE=1\nint32 SPHERE=2\nint32 CYLINDER=3\nint32 LINE_STRIP=4\nint32 LINE_LIST=5\n"
        "int32 CUBE_LIST=6\nint32 SPHERE_LIST=7\nint32 POINTS=8\nint32 TEXT_VIEW_FACING=9\nint32 MESH_RESOURCE=10\n"
        "int32 TRIANGLE_LIST=11\nint32 ADD=0\nint32 MODIFY=0\nint32 DELETE=2\nint32 DELETEALL=3\n"
        "std_msgs/Header header\nstring ns\nint32 id\nint32 type\nint32 action\ngeometry_msgs/Pose pose\n"
        "geometry_msgs/Vector3 scale\nstd_msgs/ColorRGBA color\nbuiltin_interfaces/Duration lifetime\n"
        "bool frame_locked\ngeometry_msgs/Point[] points\nstd_msgs/ColorRGBA[] colors\nstring texture_resource\n"
        "sensor_msgs/CompressedImage texture\nUVCoordinate[] uv_coordinates\nstring text\nstring mesh_resource\n"
        "MeshFile mesh_file\nbool mesh_use_embedded_materials\n",
        (_HEADER, _TIME, _POSE, _POINT, _QUATERNION, _VECTOR3, _COLOUR, _DURATION, _IMAGE, _UV, _MESH_FILE),
    ),
}


def schema_text(name: str) -> bytes:
    """Return the definition of a message type of ``SCHEMAS`` with its dependencies, in the ``ros2msg`` format."""
    body, dependencies = SCHEMAS[name]
    parts = [body, *(f"MSG: {dep}\n{text}" for dep, text in dependencies)]
    return ("\n" + "=" * 80 + "\n").join(p.rstrip("\n") for p in parts).encode() + b"\n"
