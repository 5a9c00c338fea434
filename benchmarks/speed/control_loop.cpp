// A control loop's view of an exported map: load the compiled package, ask it at batch 1, time every call.
//
//     control_loop map.pt2 k context_dim calls
//
// Prints the map's description (JSON), the actuation of action 1 ... 1 in context 1 ... 1, and the microseconds of
// each call, a line each.

#include <chrono>
#include <iostream>
#include <string>

#include <torch/csrc/inductor/aoti_package/model_package_loader.h>
#include <torch/torch.h>

int main(int, char** argv) {
    at::set_num_threads(1);
    c10::InferenceMode without_gradients;
    torch::inductor::AOTIModelPackageLoader map(argv[1], "model", /*run_single_threaded=*/true);
    const auto action = torch::ones({1, std::stol(argv[2])});
    const auto context = torch::ones({1, std::stol(argv[3])});
    std::cout << map.get_metadata().at("map") << '\n';

    const auto actuation = map.run({action, context})[0];
    std::cout.precision(9);
    for (int motor = 0; motor < actuation.size(1); ++motor) std::cout << actuation[0][motor].item<float>() << ' ';
    std::cout << '\n';

    using clock = std::chrono::steady_clock;
    for (long call = 0; call < std::stol(argv[4]); ++call) {
        const auto before = clock::now();
        map.run({action, context});
        std::cout << std::chrono::duration<double, std::micro>(clock::now() - before).count() << ' ';
    }
    std::cout << '\n';
}
