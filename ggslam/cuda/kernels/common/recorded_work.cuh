// SPDX-License-Identifier: Apache-2.0
// Work that is recorded once and then started as a whole: a CUDA graph.
#pragma once
#include "common/platform.cuh"

namespace ggslam::cuda {

// How often work was recorded, and what became of it.
enum class Recorded { kMade, kChanged, kRefused };

inline cudaError_t update_graph(cudaGraphExec_t made, cudaGraph_t graph) {
#if CUDART_VERSION >= 12000
  cudaGraphExecUpdateResultInfo result = {};
  return cudaGraphExecUpdate(made, graph, &result);
#else
  cudaGraphNode_t node = nullptr;
  cudaGraphExecUpdateResult result = cudaGraphExecUpdateSuccess;
  return cudaGraphExecUpdate(made, graph, &node, &result);
#endif
}

// Work of one shape. Neither copied nor used by two threads at a time.
class RecordedWork {
 public:
  RecordedWork() = default;
  RecordedWork(const RecordedWork&) = delete;
  RecordedWork& operator=(const RecordedWork&) = delete;
  ~RecordedWork() { forget(); }

  // Whether what was recorded is what is wanted now.
  bool is_ready() const { return ready_; }

  // What was recorded is not wanted any more; its memory may serve what is recorded next.
  void expire() { ready_ = false; }

  // Records what start() starts on a stream, on which nothing else is started meanwhile; nothing of it is executed. A
  // graph that is there already is changed where that can be done, which takes less time than to make one.
  template <class Start>
  Recorded record(cudaStream_t stream, const Start& start) {
    cudaGraph_t graph = nullptr;
    ready_ = false;
    cudaError_t status = cudaStreamBeginCapture(stream, cudaStreamCaptureModeThreadLocal);
    if (status != cudaSuccess) return refused();
    const int started = start();
    status = cudaStreamEndCapture(stream, &graph);
    if (started != 0 || status != cudaSuccess) {
      if (graph != nullptr) cudaGraphDestroy(graph);
      return refused();
    }
    const bool changed = made_ != nullptr && update_graph(made_, graph) == cudaSuccess;
    if (!changed) {
      cudaGetLastError();  // that it could not be changed is no fault
      forget();
      status = cudaGraphInstantiateWithFlags(&made_, graph, 0);
    }
    cudaGraphDestroy(graph);
    if (status != cudaSuccess) {
      made_ = nullptr;
      return refused();
    }
    ready_ = true;
    return changed ? Recorded::kChanged : Recorded::kMade;
  }

  // Starts what was recorded.
  cudaError_t launch(cudaStream_t stream) const { return cudaGraphLaunch(made_, stream); }

 private:
  static Recorded refused() {
    cudaGetLastError();
    return Recorded::kRefused;
  }

  // What was started goes on to its end.
  void forget() {
    if (made_ != nullptr) cudaGraphExecDestroy(made_);
    made_ = nullptr;
  }

  cudaGraphExec_t made_ = nullptr;
  bool ready_ = false;
};

}  // namespace ggslam::cuda
