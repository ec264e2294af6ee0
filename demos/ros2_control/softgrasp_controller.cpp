// Template, NOT compiled here: a ros2_control controller around the C that `softgrasp export controller.npz --c` writes.
//
// Parameters: axes, the names of the hand's degrees of freedom in the order of controller_size.h. It reads
// AXIS/position and AXIS/velocity and writes AXIS/effort. Samples of an observer (y) are NaN, which is "lost", until a
// subscription of yours fills them.
#include <cmath>
#include <limits>
#include <string>
#include <vector>

#include "controller_interface/controller_interface.hpp"
#include "pluginlib/class_list_macros.hpp"
#include "rclcpp/rclcpp.hpp"

extern "C" {
#include "controller.h"
}

namespace softgrasp {

using CallbackReturn = controller_interface::CallbackReturn;
using controller_interface::InterfaceConfiguration;

class SoftgraspController : public controller_interface::ControllerInterface {
public:
    CallbackReturn on_init() override {
        axes_ = auto_declare<std::vector<std::string>>("axes", {});
        return CallbackReturn::SUCCESS;
    }

    CallbackReturn on_configure(const rclcpp_lifecycle::State &) override {
        axes_ = get_node()->get_parameter("axes").as_string_array();
        if (axes_.size() != SG_CONTROLLER_INPUTS) {
            RCLCPP_ERROR(get_node()->get_logger(), "axes: %d names are needed", SG_CONTROLLER_INPUTS);
            return CallbackReturn::ERROR;
        }
        if (std::abs(get_update_rate() * SG_CONTROLLER_PERIOD - 1) > 1e-6) {
            RCLCPP_ERROR(get_node()->get_logger(), "update_rate must be %g Hz", 1 / SG_CONTROLLER_PERIOD);
            return CallbackReturn::ERROR;
        }
        return CallbackReturn::SUCCESS;
    }

    InterfaceConfiguration command_interface_configuration() const override { return named({"effort"}); }

    InterfaceConfiguration state_interface_configuration() const override { return named({"position", "velocity"}); }

    CallbackReturn on_activate(const rclcpp_lifecycle::State &) override {
        sg_controller_start(&controller_);
        for (double &sample : y_) sample = std::numeric_limits<double>::quiet_NaN();
        return CallbackReturn::SUCCESS;
    }

    controller_interface::return_type update(const rclcpp::Time &, const rclcpp::Duration &) override {
        double q[SG_CONTROLLER_INPUTS], v[SG_CONTROLLER_INPUTS], u[SG_CONTROLLER_INPUTS];
        for (int i = 0; i < SG_CONTROLLER_INPUTS; ++i) {
            q[i] = state_interfaces_[2 * i].get_value();
            v[i] = state_interfaces_[2 * i + 1].get_value();
        }
        if (sg_controller_tick(&controller_, q, v, y_, u) == SG_CONTROLLER_NO_HAND)
            return controller_interface::return_type::OK; // nothing is commanded before the hand is measured
        for (int i = 0; i < SG_CONTROLLER_INPUTS; ++i) command_interfaces_[i].set_value(u[i]);
        return controller_interface::return_type::OK;
    }

private:
    InterfaceConfiguration named(const std::vector<std::string> &kinds) const {
        InterfaceConfiguration wanted{controller_interface::interface_configuration_type::INDIVIDUAL, {}};
        for (const auto &axis : axes_)
            for (const auto &kind : kinds) wanted.names.push_back(axis + "/" + kind);
        return wanted;
    }

    sg_controller controller_;
    std::vector<std::string> axes_;
    double y_[SG_CONTROLLER_OTHERS + 1];
};

} // namespace softgrasp

PLUGINLIB_EXPORT_CLASS(softgrasp::SoftgraspController, controller_interface::ControllerInterface)
