// Subscribes to the force of every frame and logs when the grip becomes firm or loose.
//
// In a workspace with cmp_tactile: copy the folder cpp_listener into src, then
//   colcon build --packages-select cpp_listener
//   ros2 run cpp_listener listen /sample_rig/force_field

#include <cstdint>
#include <memory>
#include <string>

#include "cmp_tactile_msgs/msg/force_field.hpp"
#include "rclcpp/rclcpp.hpp"

using cmp_tactile_msgs::msg::ForceField;

constexpr double grip_limit_n = 2.0;
// With any of these flags, do not use the force (docs/results.md, "Flags").
constexpr std::uint16_t unknown =
  ForceField::FLAG_FEW_MARKERS | ForceField::FLAG_BEYOND_MARKERS | ForceField::FLAG_POOR_FIT |
  ForceField::FLAG_IMPLAUSIBLE | ForceField::FLAG_ZERO_DOUBTFUL;

// Logs when the grip becomes firm and when it becomes loose.
class GripGuard : public rclcpp::Node
{
public:
  explicit GripGuard(const std::string & topic)
  : Node("grip_guard")
  {
    subscription_ = create_subscription<ForceField>(
      topic, 10, [this](const ForceField & field) {on_force(field);});
  }

private:
  void on_force(const ForceField & field)
  {
    if ((field.flags & unknown) != 0) {
      return;  // the grip has not changed
    }
    // The force that the object exerts on the gel: a press has a negative z.
    const bool firm = -field.wrench.force.z > grip_limit_n;
    if (firm != firm_) {
      firm_ = firm;
      RCLCPP_INFO(
        get_logger(), "grip %s: %.1f N over %.0f mm2", firm ? "firm" : "loose",
        -field.wrench.force.z, 1e6 * field.contact_area);
    }
  }

  bool firm_ = false;
  rclcpp::Subscription<ForceField>::SharedPtr subscription_;
};

int main(int argc, char ** argv)
{
  const auto arguments = rclcpp::init_and_remove_ros_arguments(argc, argv);
  const std::string topic = arguments.size() > 1 ? arguments[1] : "/sample_rig/force_field";
  rclcpp::spin(std::make_shared<GripGuard>(topic));
  rclcpp::shutdown();
  return 0;
}
