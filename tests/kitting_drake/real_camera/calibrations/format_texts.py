"""Calibrations of one camera, as other tools write them.

All describe the same lens, and the same pose in the base: looking straight down from 0.9 m.
"""

LENS = "width: 64\n    height: 48\n    fx: 50.0\n    fy: 51.0\n    cx: 31.5\n    cy: 23.25\n"

OPENCV_SAMPLE = """%YAML:1.0
calibration_Time: "11/02/26 09:15:00"
nrOfFrames: 21
image_Width: 64
image_Height: 48
board_Width: 8
square_Size: 25.
# flags:  +fix_aspectRatio
flagValue: 2
Camera_Matrix: !!opencv-matrix
   rows: 3
   cols: 3
   dt: d
   data: [ 5.0000000000000000e+001, 0., 3.1500000000000000e+001, 0., 51.,
       23.25, 0., 0., 1. ]
Distortion_Coefficients: !!opencv-matrix
   rows: 5
   cols: 1
   dt: d
   data: [ 0.1, -0.05, 0.001, -0.002, 0.01 ]
"""
KALIBR = """cam0:
  cam_overlaps: [1]
  camera_model: pinhole
  distortion_coeffs: [0.1, -0.05, 0.001, -0.002]
  distortion_model: radtan
  intrinsics: [50.0, 51.0, 31.5, 23.25]
  resolution: [64, 48]
  rostopic: /left/image_raw
cam1:
  T_cn_cnm1:
  - [1.0, 0.0, 0.0, -0.11]
  - [0.0, 1.0, 0.0, 0.02]
  - [0.0, 0.0, 1.0, 0.0]
  - [0.0, 0.0, 0.0, 1.0]
  cam_overlaps: [0]
  camera_model: pinhole
  distortion_coeffs: [0.1, -0.05, 0.001, -0.002]
  distortion_model: equidistant
  intrinsics: [50.0, 51.0, 31.5, 23.25]
  resolution: [64, 48]
  rostopic: /right/image_raw
"""
# Written by Open3D 0.20.
OPEN3D_INTRINSIC = (
    '{\n\t"height" : 48,\n\t"intrinsic_matrix" : [ 50.0, 0.0, 0.0, 0.0, 51.0, 0.0, 31.5, 23.25, '
    '1.0 ],\n\t"width" : 64\n}'
)
OPEN3D_PARAMETERS = (
    '{\n\t"class_name" : "PinholeCameraParameters",\n\t"extrinsic" : \n\t[\n\t\t-0.0,\n\t\t-1.0,\n'
    "\t\t-0.0,\n\t\t0.0,\n\t\t-1.0,\n\t\t-0.0,\n\t\t-0.0,\n\t\t0.0,\n\t\t-0.0,\n\t\t-0.0,\n"
    "\t\t-1.0,\n\t\t0.0,\n\t\t0.10000000000000001,\n\t\t0.5,\n\t\t0.90000000000000002,\n\t\t1.0\n"
    '\t],\n\t"intrinsic" : \n\t{\n\t\t"height" : 48,\n\t\t"intrinsic_matrix" : [ 50.0, 0.0, 0.0, '
    '0.0, 51.0, 0.0, 31.5, 23.25, 1.0 ],\n\t\t"width" : 64\n\t},\n\t"version_major" : 1,\n'
    '\t"version_minor" : 0\n}'
)
# Written by Open3D's recorder for the Azure Kinect.
OPEN3D_AZURE = (
    '{\n    "color_mode": "MJPG_720P", "depth_mode": "NFOV_UNBINNED", "height": 48,\n'
    '    "intrinsic_matrix": [50.0, 0, 0, 0, 51.0, 0, 31.5, 23.25, 1],\n'
    '    "serial_number_": "000123", "stream_length_usec": 1000000, "width": 64\n}'
)
REALSENSE = """Device info:
    Name                          : 	Intel RealSense D435I

 Intrinsic of "Depth" / 64x48 / {Z16}
  Width:      	64
  Height:     	48
  PPX:        	32.1
  PPY:        	24.2
  Fx:         	39.0
  Fy:         	39.0
  Distortion: 	Brown Conrady
  Coeffs:     	0  	0  	0  	0  	0
  FOV (deg):  	78.7 x 63.17

 Intrinsic of "Color" / 64x48 / {YUYV/RGB8/BGR8/RGBA8/BGRA8/Y8}
  Width:      	64
  Height:     	48
  PPX:        	31.5
  PPY:        	23.25
  Fx:         	50.0
  Fy:         	51.0
  Distortion: 	Inverse Brown Conrady
  Coeffs:     	0  	0  	0  	0  	0
  FOV (deg):  	65.1 x 50.3

 Intrinsic of "Color" / 128x96 / {YUYV/RGB8/BGR8/RGBA8/BGRA8/Y8}
  Width:      	128
  Height:     	96
  PPX:        	63.5
  PPY:        	47
  Fx:         	100
  Fy:         	102
  Distortion: 	Inverse Brown Conrady
  Coeffs:     	-0.05  	0.06  	0.0004  	0.0001  	-0.02
  FOV (deg):  	65.1 x 50.3
"""
PYREALSENSE_JSON = (
    '{"width": 64, "height": 48, "ppx": 31.5, "ppy": 23.25, "fx": 50.0, "fy": 51.0, '
    '"model": "distortion.inverse_brown_conrady", "coeffs": [0.0, 0.0, 0.0, 0.0, 0.0]}'
)
PYREALSENSE_TEXT = "[ 64x48  p[31.5 23.25]  f[50 51]  Inverse Brown Conrady [0 0 0 0 0] ]\n"

TF_ECHO = """At time 1416409795.450
- Translation: [0.500, 0.100, 0.900]
- Rotation: in Quaternion [0.70710678, -0.70710678, 0.000, 0.000]
            in RPY (radian) [3.142, -0.000, -1.571]
            in RPY (degree) [180.000, -0.000, -90.000]
"""
TF2_ECHO = """$ ros2 run tf2_ros tf2_echo base_link front_color_optical_frame
[INFO] [1767668011.1] [tf2_echo]: Waiting for transform base_link ->  front_color_optical_frame
At time 1767668011.72768865
- Translation: [0.500, 0.100, 0.900]
- Rotation: in Quaternion (xyzw) [0.70710678, -0.70710678, 0.000, 0.000]
- Rotation: in RPY (radian) [3.142, 0.000, -1.571]
- Rotation: in RPY (degree) [180.000, 0.000, -90.000]
- Matrix:
  0.000 -1.000  0.000  0.500
 -1.000  0.000  0.000  0.100
  0.000  0.000 -1.000  0.900
  0.000  0.000  0.000  1.000
"""
EASY_HANDEYE = """parameters:
  eye_on_hand: false
  freehand_robot_movement: false
  move_group: manipulator
  namespace: /front_eye_on_base/
  robot_base_frame: base_link
  robot_effector_frame: tool0
  tracking_base_frame: camera_color_optical_frame
  tracking_marker_frame: aruco_marker_frame
transformation:
  qw: 0.0
  qx: 0.70710678118
  qy: -0.70710678118
  qz: 0.0
  x: 0.5
  y: 0.1
  z: 0.9
"""
EASY_HANDEYE_OLD = """eye_on_hand: false
robot_base_frame: base_link
tracking_base_frame: camera_rgb_optical_frame
transformation: {qw: 0.0, qx: 0.70710678118, qy: -0.70710678118, qz: 0.0, x: 0.5, y: 0.1, z: 0.9}
"""
EASY_HANDEYE2 = """parameters:
  name: front
  calibration_type: eye_on_base
  tracking_base_frame: camera_color_optical_frame
  tracking_marker_frame: marker_frame
  robot_base_frame: base_link
  robot_effector_frame: tool0
  freehand_robot_movement: true
  move_group_namespace: /
  move_group: manipulator
transform:
  translation:
    x: 0.5
    y: 0.1
    z: 0.9
  rotation:
    x: 0.70710678118
    y: -0.70710678118
    z: 0.0
    w: 0.0
"""
MOVEIT_LAUNCH = """<launch>
  <!-- The rpy in the comment uses the extrinsic XYZ convention. -->
  <!-- xyz="0.5 0.1 0.9" rpy="3.14159 0 -1.5708" -->
  <node pkg="tf2_ros" type="static_transform_publisher" name="camera_link_broadcaster"
      args="0.5 0.1 0.9   0.70710678 -0.70710678 0 0 panda_link0 camera_color_optical_frame" />
</launch>
"""
MOVEIT_PYTHON = '''""" Static transform publisher acquired via MoveIt 2 hand-eye calibration """
""" EYE-TO-HAND: fr3_link0 -> camera_color_optical_frame """
from launch import LaunchDescription
from launch_ros.actions import Node


def generate_launch_description() -> LaunchDescription:
    nodes = [
        Node(
            package="tf2_ros",
            executable="static_transform_publisher",
            output="log",
            arguments=[
                "--frame-id",
                "fr3_link0",
                "--child-frame-id",
                "camera_color_optical_frame",
                "--x",
                "0.5",
                "--y",
                "0.1",
                "--z",
                "0.9",
                "--qx",
                "0.70710678",
                "--qy",
                "-0.70710678",
                "--qz",
                "0",
                "--qw",
                "0",
                # "--roll",
                # "3.14159",
            ],
        ),
    ]
    return LaunchDescription(nodes)
'''
ROS2_ARGUMENTS = (
    "ros2 run tf2_ros static_transform_publisher --x 0.5 --y 0.1 --z 0.9 --roll 3.14159265359 "
    "\\\n  --yaw=-1.57079632679 --frame-id base_link --child-frame-id camera_color_optical_frame\n"
)
ROS1_ARGUMENTS = (
    "rosrun tf static_transform_publisher 0.5 0.1 0.9 -1.57079632679 0 3.14159265359 base_link "
    "camera_color_optical_frame 100 __name:=eye\n"
)
# The inverse transform: the pose of the base in the camera's frame.
INVERSE_STAMPED = """header:
  stamp: {sec: 0, nanosec: 0}
  frame_id: front_color_optical_frame
child_frame_id: base_link
transform:
  translation: {x: 0.1, y: 0.5, z: 0.9}
  rotation: {x: 0.70710678118, y: -0.70710678118, z: 0.0, w: 0.0}
"""
TF_STATIC = """transforms:
- header: {frame_id: base_link}
  child_frame_id: link_1
  transform:
    translation: {x: 0.0, y: 0.0, z: 0.3}
    rotation: {x: 0.0, y: 0.0, z: 0.0, w: 1.0}
- header: {frame_id: base_link}
  child_frame_id: front_color_optical_frame
  transform:
    translation: {x: 0.5, y: 0.1, z: 0.9}
    rotation: {x: 0.70710678118, y: -0.70710678118, z: 0.0, w: 0.0}
---
"""
# Written by numpy.savetxt.
MATRIX = """0.000000000000000000e+00 -1.000000000000000000e+00 0.0 5.000000000000000000e-01
-1.0e+00 0.0 0.0 1.000000000000000056e-01
0.0 0.0 -1.0 9.000000000000000222e-01
0.0 0.0 0.0 1.0
"""
