# %% [markdown]
# # search
# %%
print(1)
