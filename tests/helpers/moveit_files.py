"""A scene and a request as MotionBenchMaker writes them, by hand from the documented messages."""

SCENE = """
name: table top
robot_model_name: panda
robot_state:
  joint_state:
    name: [left_hand_synergy]
    position: [0.2]
  attached_collision_objects:
    - link_name: palm
      object:
        id: cup
        header: {frame_id: palm}
        pose: {position: [0, 0.02, -0.05], orientation: [0, 0, 0, 1]}
        primitives: [{type: cylinder, dimensions: [0.1, 0.03]}]
        primitive_poses: [{position: [0, 0, 0.01], orientation: [0, 0, 0, 1]}]
      touch_links: [palm, unheard_of]
world:
  collision_objects:
    - id: "base "
      header: {frame_id: base_link}
      pose: {position: [0.5, 0.0, 0.1], orientation: [0, 0, 0.7071068, 0.7071068]}
      primitives:
        - {type: box, dimensions: [0.4, 0.1, 0.2]}
        - {type: sphere, dimensions: [0.05]}
      primitive_poses:
        - {position: [0, 0, 0], orientation: [0, 0, 0, 1]}
        - {position: [0.1, 0, 0.2], orientation: [0, 0, 0, 1]}
    - id: pillar
      header: {frame_id: world}
      primitives: [{type: 3, dimensions: [0.6, 0.04]}]
      primitive_poses: [{position: {x: 0.45, y: 0.1, z: 0.3}, orientation: {x: 0, y: 0, z: 0, w: 1}}]
    - id: rock
      meshes: [{resource: rock.obj, dimensions: [0.1, 0.1, 0.1]}]
      mesh_poses: [{position: [0.7, -0.6, 0.1], orientation: [0, 0, 0, 1]}]
"""

REQUEST = """
group_name: both_arms
planner_id: RRTConnect
start_state:
  joint_state:
    name: [panda_joint1, panda_joint2, panda_joint4, finger]
    position: [0.6, 0.3, -1.6, 0.0]
goal_constraints:
  - joint_constraints:
      - {joint_name: panda_joint1, position: -1.35, tolerance_above: 0.001, tolerance_below: 0.001, weight: 1}
      - {joint_name: panda_joint2, position: 0.3}
      - {joint_name: panda_joint4, position: -1.6}
"""
