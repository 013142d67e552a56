// SPDX-License-Identifier: Apache-2.0
namespace ggslam::GGSLAM_ISA { int placeholder() { return 0; } }
